from setuptools import find_packages, setup

NAME = "knee_gap_replay"

setup(
    name=NAME,
    version="0.1.0",
    description="Commands on bags of knee_gap: play, record, process, check, report, evaluate.",
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
            "check = knee_gap_replay.entry_points:check",
            "evaluate = knee_gap_replay.entry_points:evaluate",
            "import_motive = knee_gap_replay.entry_points:import_motive",
            "play = knee_gap_replay.entry_points:play",
            "process = knee_gap_replay.entry_points:process",
            "record = knee_gap_replay.entry_points:record",
            "report = knee_gap_replay.entry_points:report",
        ],
    },
)
