"""ament_python package: libraries, shared files, and one executable per command."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = "eha_monitor"
ROOT = Path(__file__).parent


def files(folder: str) -> list[str]:
    """Return the files directly in ``folder``, relative to the package root."""
    return sorted(str(path.relative_to(ROOT)) for path in (ROOT / folder).glob("*")
                  if path.is_file())


def shared(folder: str) -> list[tuple[str, list[str]]]:
    """Return the ``data_files`` entries that put ``folder``, with its subfolders, in share/."""
    folders = [ROOT / folder, *(path for path in (ROOT / folder).rglob("*") if path.is_dir())]
    relative = [str(path.relative_to(ROOT)) for path in sorted(folders)]
    return [(f"share/{NAME}/{name}", files(name)) for name in relative if files(name)]


setup(
    name=NAME,
    version="0.1.0",
    description="Condition monitor for electrohydraulic actuators",
    license="Apache-2.0",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "signatures.json", "reports/templates/*", "dashboard/*.css",
                         "dashboard/*.js",
                         "exports/fmu/*.c", "exports/templates/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *shared("config"),
        *shared("launch"),
        *shared("bags"),
        # `ros2 run` looks here, after `pip install` and after `colcon build` alike.
        (f"lib/{NAME}", files("executables")),
    ],
    python_requires=">=3.11",
    zip_safe=False,
    install_requires=[  # docs/dependencies.md gives the reason for each
        "click",
        "filterpy",
        "jinja2",
        "lz4",
        "matplotlib",
        "mcap",
        "numba",
        "numpy",
        "pandas",
        "pillow",
        "pint",
        "plotly",
        "pydantic",
        "rich",
        "rosbags",
        "ruamel.yaml",
        "scipy",
        "zstandard",
    ],
    extras_require={
        # An apt installation of ROS has no distributions of these names, so they are optional.
        "ros": ["ros-jazzy-common-interfaces", "ros-jazzy-rclpy[fastrtps]"],
        # The page of the `dashboard` command; nothing else needs a web server.
        "dashboard": ["fastapi", "nicegui", "prometheus-client", "uvicorn"],
        # Its option --foxglove.
        "foxglove": ["foxglove-sdk"],
        # The table of a folder of bags; 170 MB that nothing else needs.
        "archive": ["pyarrow"],
        # Its option --scheduler.
        "dask": ["distributed"],
        # The C compiler that links an FMU, for Linux and Windows; 400 MB that nothing else needs.
        "export": ["ziglang"],
        "test": ["casadi", "fmpy", "griffelib", "hypothesis", "ipykernel", "mujoco", "nbclient",
                 "nbformat", "playwright", "pymoca", "pytest", "pytest-rerunfailures",
                 "pytest-timeout", "pytest-xdist", "ruff", "urdf-parser-py", "websockets"],
        "colcon": ["colcon-bash", "colcon-core", "colcon-output", "colcon-package-selection",
                   "colcon-python-setup-py", "colcon-recursive-crawl", "colcon-ros"],
    },
    entry_points={"console_scripts": ["eha-monitor = eha_monitor.__main__:main"]},
)
