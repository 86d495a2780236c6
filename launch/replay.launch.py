"""A recorded bag through the monitor: ros2 launch eha_monitor replay.launch.py bag:=BAG."""

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import EqualsSubstitution, LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription


def generate_launch_description():
    config = LaunchConfiguration("config")
    default = EqualsSubstitution(config, "")
    monitor = {"package": "eha_monitor", "executable": "monitor", "output": "screen",
               "parameters": [{"use_sim_time": True}]}
    return LaunchDescription([
        DeclareLaunchArgument("bag", description="bag to replay"),
        DeclareLaunchArgument("rate", default_value="1.0", description="times real time"),
        DeclareLaunchArgument("config", default_value="",
                              description="config of the rig; without it the paper's EHA"),
        Node(**monitor, condition=IfCondition(default)),
        Node(**monitor, arguments=["--config", config],
             condition=UnlessCondition(default)),
        Node(package="eha_monitor", executable="replay", output="screen",
             arguments=[LaunchConfiguration("bag"), "--clock", "--rate",
                        LaunchConfiguration("rate")]),
    ])
