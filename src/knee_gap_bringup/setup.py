from glob import glob

from setuptools import find_packages, setup

NAME = "knee_gap_bringup"

setup(
    name=NAME,
    version="0.1.0",
    description="Start-up of knee_gap: launch files, settings, the demo and an example leg controller.",
    license="Apache-2.0",
    maintainer="knee_gap maintainers",
    maintainer_email="maintainers@knee-gap.invalid",
    packages=find_packages(),
    package_data={"": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/" + NAME]),
        ("share/" + NAME, ["package.xml"]),
        ("share/" + NAME + "/launch", sorted(glob("launch/*.launch.py"))),
        ("share/" + NAME + "/config", sorted(glob("config/*"))),
    ],
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "closed_loop = knee_gap_bringup.entry_points:closed_loop",
            "demo = knee_gap_bringup.entry_points:demo",
            "leg_controller_node = knee_gap_bringup.entry_points:leg_controller_node",
            "live = knee_gap_bringup.entry_points:live",
            "replay = knee_gap_bringup.entry_points:replay",
            "suite_node = knee_gap_bringup.entry_points:suite_node",
        ],
    },
)
