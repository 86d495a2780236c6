"""Monitor a real actuator: ros2 launch eha_monitor live.launch.py config:=rig.yaml."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import LaunchConfigurationEquals, LaunchConfigurationNotEquals
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    config = LaunchConfiguration("config")
    return LaunchDescription([
        DeclareLaunchArgument("config", default_value="",
                              description="config of the rig; without it the paper's EHA"),
        Node(package="eha_monitor", executable="monitor", output="screen",
             condition=LaunchConfigurationEquals("config", "")),
        Node(package="eha_monitor", executable="monitor", output="screen",
             arguments=["--config", config],
             condition=LaunchConfigurationNotEquals("config", "")),
    ])
