"""The simulated actuator and its monitor: ros2 launch eha_monitor demo.launch.py."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import LaunchConfigurationEquals, LaunchConfigurationNotEquals
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

NODES = ("simulator", "monitor")


def generate_launch_description():
    config = LaunchConfiguration("config")
    default = [Node(package="eha_monitor", executable=name, output="screen",
                    condition=LaunchConfigurationEquals("config", "")) for name in NODES]
    configured = [Node(package="eha_monitor", executable=name, output="screen",
                       arguments=["--config", config],
                       condition=LaunchConfigurationNotEquals("config", "")) for name in NODES]
    return LaunchDescription([
        DeclareLaunchArgument("config", default_value="",
                              description="config with the rig and its faults; without it the "
                              "paper's EHA in good health"),
        *default, *configured,
    ])
