"""Settings of a monitor, from one ROS 2 parameter file."""
