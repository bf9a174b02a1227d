# SPDX-License-Identifier: Apache-2.0
"""ament_python package; `pip install -e .` works too."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = "limbloc_ros"
SHARE = f"share/{NAME}"
NODES = (
    "segmentation",
    "carving",
    "pose",
    "simulated_cameras",
    "replay",
    "record",
    "composed",
    "foxglove_bridge",
)


def files(pattern: str) -> list[str]:
    """Files of the source tree, relative to it, as data_files wants them."""
    return sorted(str(path) for path in Path().glob(pattern) if path.is_file())


setup(
    name=NAME,
    version="0.1.0",
    description="Markerless 3D human posture from a few calibrated cameras, as ROS 2 nodes and offline",
    author="limbloc maintainers",
    author_email="maintainers@limbloc.org",
    maintainer="limbloc maintainers",
    maintainer_email="maintainers@limbloc.org",
    license="Apache-2.0",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "core/*.npz", "simulation/data/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (SHARE, ["package.xml"]),
        (f"{SHARE}/launch", files("launch/*")),
        (f"{SHARE}/config", files("config/*")),
        (f"{SHARE}/config/sros2", files("config/sros2/*")),
    ],
    python_requires=">=3.11",
    # Tests of core, bags, nodes and report were run at both ends: the lower one with Python 3.11 and what Ubuntu 24.04
    # (Jazzy) has in apt, save for rosbags, which it has not; the upper one with Python 3.11 and 3.12.
    install_requires=[
        "numpy>=1.26,<3",
        "scipy>=1.11,<2",
        "numba>=0.58,<0.69",
        "opencv-python-headless>=4.6,<5",
        "PyYAML>=6,<7",
        "rosbags>=0.11.6,<0.12",
        "tqdm>=4.66,<5",
        "matplotlib>=3.6,<4",
    ],
    extras_require={
        "dev": [
            "psutil>=5.9,<8",
            "pytest>=8,<10",
            "pytest-xdist>=3.6,<4",
            "hypothesis>=6.100,<7",
            "ruff==0.17.6",
            "mypy==2.4.1",
            "types-PyYAML",
            "scipy-stubs",
            "ezc3d>=1.6.3,<2",
            "foxglove-sdk>=0.20,<0.31",
            "websockets>=13,<18",
            "distributed>=2024.8,<2027",
        ],
        "cluster": ["distributed>=2024.8,<2027"],  # many recordings on the machines of a Dask cluster
        "fuzz": ["atheris>=3.0,<4"],  # make fuzz
        "export": ["ezc3d>=1.6.3,<2"],  # C3D; the other formats need nothing
        "foxglove": ["foxglove-sdk>=0.20,<0.31"],  # a live view in a browser
        "docs": ["mkdocs>=1.6,<2", "mkdocs-material>=9.6,<10", "mkdocstrings[python]>=1.0,<2"],
        "viewer": ["open3d-cpu>=0.19,<0.21"],
    },
    zip_safe=False,
    entry_points={
        "console_scripts": [
            f"limbloc = {NAME}.cli:main",
            f"smart_space = {NAME}.nodes.smart_space:main",
            *(f"{node} = {NAME}.nodes.start:{node}" for node in NODES),
        ],
    },
)
