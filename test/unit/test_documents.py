"""The documents name what there is: files, modules, rooms and executables."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCES = ROOT / "src"
PAGES = sorted(
    [
        *ROOT.glob("*.md"),
        *(ROOT / "docs").rglob("*.md"),
        *(ROOT / "bags").glob("*.md"),
        *SOURCES.glob("*/*.md"),
    ]
)
# The history uses the names that things had then.
PRESENT = [page for page in PAGES if page.name != "CHANGELOG.md"]
PACKAGES = sorted(path.name for path in SOURCES.iterdir() if (path / "package.xml").is_file())
ARCHITECTURE = ROOT / "docs" / "architecture.md"


def named(pages: list[Path]) -> list[object]:
    return [pytest.param(page, id=str(page.relative_to(ROOT))) for page in pages]


def anchor_of(heading: str) -> str:
    """The anchor that a heading of a page gets."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")


@pytest.mark.parametrize("page", named(PAGES))
def test_links_lead_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if re.match(r"\w+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        if anchor:
            headings = re.findall(r"^#+ (.*)$", target.read_text(), re.MULTILINE)
            assert anchor in {anchor_of(heading) for heading in headings}, link


@pytest.mark.parametrize("page", named(PRESENT))
def test_modules_and_files_that_a_page_names_exist(page: Path) -> None:
    text = page.read_text()
    for name in re.findall(r"\b(?:bench|test|docs|src|tools|bags)/[\w/.]+\.(?:py|md|png|jpg|yaml)\b", text):
        assert (ROOT / name).exists() or (page.parent / name).exists(), name
    for dotted in re.findall(r"\bknee_gap_\w+(?:\.[a-z_]\w*)+", text):
        package, *inside = dotted.split(".")
        assert any(
            path.exists()
            # The last name may be one inside a module.
            for end in (inside, inside[:-1])
            if end
            for path in (
                (SOURCES / package / package).joinpath(*end).with_suffix(".py"),
                (SOURCES / package / package).joinpath(*end, "__init__.py"),
                # Messages are generated from files.
                (SOURCES / package).joinpath(*end),
            )
        ), dotted
    for module in re.findall(r"`((?:[a-z_0-9]+/)*(?!my_)[a-z_0-9]+\.py)`", text):
        assert [*ROOT.glob(f"src/**/{module}"), *ROOT.glob(f"test/**/{module}"), *ROOT.glob(module)], module


@pytest.mark.parametrize("package", PACKAGES)
def test_each_package_has_a_short_page_with_its_executables(package: str) -> None:
    text = (SOURCES / package / "README.md").read_text()
    assert len(text.splitlines()) <= 60
    setup = SOURCES / package / "setup.py"
    scripts = re.findall(r'"(\w+) = [\w.]+:\w+"', setup.read_text()) if setup.exists() else []
    assert [name for name in scripts if f"`{name}`" not in text] == []


@pytest.mark.parametrize("package", [name for name in PACKAGES if (SOURCES / name / name).is_dir()])
def test_each_room_has_its_line(package: str) -> None:
    rooms = sorted(path.parent.name for path in (SOURCES / package / package).glob("*/__init__.py"))
    section = ARCHITECTURE.read_text().partition(f"| `{package}` |")[2].partition("\n\n")[0]
    assert [room for room in rooms if f"| `{room}`" not in section] == []
    page = (SOURCES / package / "README.md").read_text()
    assert [room for room in rooms if f"| `{room}/`" not in page] == []


def test_the_first_page_is_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) < 150
