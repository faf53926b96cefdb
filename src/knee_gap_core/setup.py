from setuptools import find_packages, setup

NAME = "knee_gap_core"

setup(
    name=NAME,
    version="0.1.0",
    description="What every package of knee_gap stands on: values, bags, parameters, start and stop.",
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
        "console_scripts": [],
    },
)
