"""The simulated actuator and its monitor: ros2 launch eha_monitor demo.launch.py."""

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import EqualsSubstitution, LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

NODES = ("simulator", "monitor")


def generate_launch_description():
    config = LaunchConfiguration("config")
    default = EqualsSubstitution(config, "")
    plain = [Node(package="eha_monitor", executable=name, output="screen",
                  condition=IfCondition(default)) for name in NODES]
    configured = [Node(package="eha_monitor", executable=name, output="screen",
                       arguments=["--config", config],
                       condition=UnlessCondition(default)) for name in NODES]
    return LaunchDescription([
        DeclareLaunchArgument("config", default_value="",
                              description="config with the rig and its faults; without it the "
                              "paper's EHA in good health"),
        *plain, *configured,
    ])
