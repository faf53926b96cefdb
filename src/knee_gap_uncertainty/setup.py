from setuptools import find_packages, setup

NAME = "knee_gap_uncertainty"

setup(
    name=NAME,
    version="0.1.0",
    description="How wide the instrument gap is, and how sure that is.",
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
            "coverage = knee_gap_uncertainty.entry_points:coverage",
            "joint_motion_table = knee_gap_uncertainty.entry_points:joint_motion_table",
            "study = knee_gap_uncertainty.entry_points:study",
            "uncertainty_node = knee_gap_uncertainty.entry_points:uncertainty_node",
        ],
    },
)
