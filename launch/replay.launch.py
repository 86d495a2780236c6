"""A recorded bag through the monitor: ros2 launch eha_monitor replay.launch.py bag:=BAG."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import LaunchConfigurationEquals, LaunchConfigurationNotEquals
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    config = LaunchConfiguration("config")
    monitor = {"package": "eha_monitor", "executable": "monitor", "output": "screen",
               "parameters": [{"use_sim_time": True}]}
    return LaunchDescription([
        DeclareLaunchArgument("bag", description="bag to replay"),
        DeclareLaunchArgument("rate", default_value="1.0", description="times real time"),
        DeclareLaunchArgument("config", default_value="",
                              description="config of the rig; without it the paper's EHA"),
        Node(**monitor, condition=LaunchConfigurationEquals("config", "")),
        Node(**monitor, arguments=["--config", config],
             condition=LaunchConfigurationNotEquals("config", "")),
        Node(package="eha_monitor", executable="replay", output="screen",
             arguments=[LaunchConfiguration("bag"), "--clock", "--rate",
                        LaunchConfiguration("rate")]),
    ])
