"""Why there is no bag at a path, in the same words for every command."""

from pathlib import Path


def missing_bag(path: Path) -> str:
    """Why there can be no MCAP bag at `path`, a file or a folder; empty where there may be one."""
    if not path.exists():
        return f"{path} does not exist"
    if path.is_file():
        return f"{path} is empty" if path.stat().st_size == 0 else ""
    if not any(path.glob("*.mcap")):
        return f"{path} holds no MCAP file"
    return ""
