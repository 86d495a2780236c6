"""Monitor a real actuator: ros2 launch eha_monitor live.launch.py config:=rig.yaml."""

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import EqualsSubstitution, LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription


def generate_launch_description():
    config = LaunchConfiguration("config")
    default = EqualsSubstitution(config, "")
    return LaunchDescription([
        DeclareLaunchArgument("config", default_value="",
                              description="config of the rig; without it the paper's EHA"),
        Node(package="eha_monitor", executable="monitor", output="screen",
             condition=IfCondition(default)),
        Node(package="eha_monitor", executable="monitor", output="screen",
             arguments=["--config", config],
             condition=UnlessCondition(default)),
    ])
