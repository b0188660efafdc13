# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

# The nodes in an image, run as a user who can change nothing of it:
#   docker build -t fdi_ros .
#   docker run --rm --net=host -v "$PWD/my_sensors.yaml:/config.yaml:ro" fdi_ros
#   docker run --rm --net=host -v fdi:/home/fdi/.ros fdi_ros mavlink_node --ros-args --params-file config/px4.yaml -p url:=udpin:0.0.0.0:14540
FROM ros:jazzy-ros-base

WORKDIR /opt/fdi_ws
COPY . src/fdi_ros

RUN apt-get update \
    && rosdep update --rosdistro jazzy \
    && rosdep install --rosdistro jazzy --from-paths src --ignore-src --dependency-types exec -y \
    && rm -rf /var/lib/apt/lists/*

# An init, as a process without a handler gets no signal as the first one; and what mavlink_node and recordings need, which
# no distribution of ROS has. NumPy stays that of Ubuntu, which its Numba was built for.
RUN apt-get update \
    && apt-get install -y --no-install-recommends tini python3-pip \
    && pip install --break-system-packages --no-cache-dir "numpy<2" pymavlink pyserial mcap rosbags lz4 zstandard \
    && rm -rf /var/lib/apt/lists/*

# The build compiles: no start has to. Readable for the user, however closed the files are where this is built.
RUN . /opt/ros/jazzy/setup.sh && colcon build --packages-select fdi_ros \
    && chmod -R a+rX install \
    && ln -s install/fdi_ros/share/fdi_ros/config config

# The folder of files that outlive a restart is there for a volume, which takes over its owner.
RUN useradd --create-home fdi && install --directory --owner=fdi --group=fdi /home/fdi/.ros
USER fdi
# Nodes of different users do not see each other over shared memory.
ENV FASTDDS_BUILTIN_TRANSPORTS=UDPv4

ENTRYPOINT ["tini", "--", "/ros_entrypoint.sh", "bash", "-c", ". install/local_setup.bash && exec install/fdi_ros/lib/fdi_ros/$0 \"$@\""]
CMD ["fdi_node", "--ros-args", "--params-file", "/config.yaml"]
