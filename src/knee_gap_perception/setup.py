from setuptools import find_packages, setup

NAME = "knee_gap_perception"

setup(
    name=NAME,
    version="0.1.0",
    description="What the scope sees and where it is: edges of the instrument gap and the pose of the lens.",
    license="Apache-2.0",
    maintainer="knee_gap maintainers",
    maintainer_email="maintainers@knee-gap.invalid",
    packages=find_packages(),
    package_data={"": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/" + NAME]),
        ("share/" + NAME, ["package.xml"]),
    ],
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "calibrate = knee_gap_perception.calibration.command:main",
            "evaluate = knee_gap_perception.evaluate:main",
            "segmentation_node = knee_gap_perception.segmentation_node:main",
            "tracker_precision = knee_gap_perception.tracker_precision_command:main",
            "tracking_node = knee_gap_perception.tracking_node:main",
        ],
    },
)
