# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

# Sourced by the scripts beside it: which Python, which ROS, and an environment that neither was made for.

# Images of Python are often made with it; every start of a process would then compile the sources of Numba anew, 2 s.
unset PYTHONDONTWRITEBYTECODE

# Interpreter of 3.10 or newer: the one asked for, else the first that fits.
find_python() {
    local candidate
    for candidate in ${1:-python3 python3.12 python3.13 python3.11 python3.10}; do
        if "$candidate" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 15))' 2>/dev/null; then
            # Of an environment that is active the interpreter it was made with: .venv itself may be made anew.
            "$candidate" -c 'import sys; print(sys._base_executable)'
            return
        fi
    done
    echo "no Python 3.10 to 3.14 found as ${1:-python3}: install one, or name it with PYTHON=..." >&2
    return 1
}

# "system" if ROS 2 Jazzy is sourced and this interpreter can load it, else "wheels".
ros_mode() {
    if [ "${ROS_DISTRO:-}" = jazzy ] && [ -z "${_ROS_WHEELS_BOOTSTRAP_COMPLETE:-}" ] \
        && "$1" -c 'import rclpy, sensor_msgs, diagnostic_msgs' 2>/dev/null; then
        echo system
    else
        echo wheels
    fi
}

# Forget another Python's or another ROS's paths: libraries of theirs must not be loaded into the wheels.
clean_environment() {
    if [ -n "${ROS_DISTRO:-}${_ROS_WHEELS_BOOTSTRAP_COMPLETE:-}" ]; then
        unset LD_LIBRARY_PATH
    fi
    unset _ROS_WHEELS_BOOTSTRAP_COMPLETE PYTHONPATH PYTHONHOME AMENT_PREFIX_PATH RMW_IMPLEMENTATION
    unset ROS_DISTRO ROS_VERSION ROS_PYTHON_VERSION COLCON_PREFIX_PATH CMAKE_PREFIX_PATH
}
