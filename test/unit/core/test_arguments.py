"""Command lines: options may stand anywhere, and a mistake is one line."""

import pytest

from knee_gap_core.node.arguments import Parser


def parser() -> Parser:
    made = Parser(prog="record")
    made.add_argument("out")
    made.add_argument("--force", action="store_true")
    made.add_argument("topics", nargs="*")
    return made


@pytest.mark.parametrize(
    "line", ["OUT --force /a /b", "--force OUT /a /b", "OUT /a --force /b", "OUT /a /b --force"]
)
def test_options_may_stand_between_positional_arguments(line: str) -> None:
    given = parser().parse(line.split())
    assert (given.out, given.force, given.topics) == ("OUT", True, ["/a", "/b"])


def test_a_name_may_begin_with_a_dash_after_two() -> None:
    assert parser().parse(["--force", "--", "-bag"]).out == "-bag"


@pytest.mark.parametrize("line", ["", "OUT --no-such /a"])
def test_a_mistake_is_one_line_and_exit_code_2(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        parser().parse(line.split())
    assert ended.value.code == 2
    written = capsys.readouterr().err
    assert written.startswith("record: ")
    assert written.count("\n") == 1


def test_subcommands_are_parsed_as_well() -> None:
    made = Parser(prog="calibrate")
    made.add_subparsers(dest="step", required=True).add_parser("camera").add_argument("bag")
    assert made.parse(["camera", "BAG"]).bag == "BAG"
