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
    package_data={"": ["py.typed", "*.html", "*.onnx"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/" + NAME]),
        ("share/" + NAME, ["package.xml"]),
    ],
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "calibrate = knee_gap_perception.entry_points:calibrate",
            "mark = knee_gap_perception.entry_points:mark",
            "segmentation_node = knee_gap_perception.entry_points:segmentation_node",
            "tracker_precision = knee_gap_perception.entry_points:tracker_precision",
            "tracking_node = knee_gap_perception.entry_points:tracking_node",
            "train_segmentation = knee_gap_perception.entry_points:train_segmentation",
        ],
    },
)
