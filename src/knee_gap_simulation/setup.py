from setuptools import find_packages, setup

NAME = "knee_gap_simulation"

setup(
    name=NAME,
    version="0.1.0",
    description="Simulated knees of known gap, with a simulated arthroscope and tracker.",
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
            "compare_looks = knee_gap_simulation.entry_points:compare_looks",
            "contact_sheet = knee_gap_simulation.entry_points:contact_sheet",
            "make_bag = knee_gap_simulation.entry_points:make_bag",
            "natnet_server = knee_gap_simulation.entry_points:natnet_server",
            "render_examples = knee_gap_simulation.entry_points:render_examples",
        ],
    },
)
