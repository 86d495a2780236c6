"""Monitor real actuators: ros2 launch eha_monitor live.launch.py config:=rig.yaml.

Several in one process: actuators:="left=left.yaml right=right.yaml".
"""

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription


def monitor(context):
    """Return the monitor with the command's arguments."""
    config, actuators, inactive = (LaunchConfiguration(name).perform(context)
                                   for name in ("config", "actuators", "inactive"))
    arguments = ["--config", config] if config else []
    for actuator in actuators.split():
        arguments += ["--actuator", actuator]
    if inactive.lower() in ("true", "1"):
        arguments.append("--inactive")
    return [Node(package="eha_monitor", executable="monitor", output="screen",
                 arguments=arguments)]


def generate_launch_description():
    return LaunchDescription([
        DeclareLaunchArgument("config", default_value="",
                              description="config of the rig; without it the paper's EHA"),
        DeclareLaunchArgument("actuators", default_value="",
                              description="instead: NAME=CONFIG of each of several actuators, "
                              "separated by spaces; NAME is the namespace"),
        DeclareLaunchArgument("inactive", default_value="false",
                              description="true: wait for the transition 'activate'"),
        OpaqueFunction(function=monitor),
    ])
