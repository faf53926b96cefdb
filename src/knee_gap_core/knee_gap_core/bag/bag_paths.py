"""The reason why there is not a bag at a path, in the same words for every command."""

import os
import stat
from pathlib import Path

from knee_gap_core.user_files import FileError, open_file, reason_of, shown


def missing_bag(path: Path) -> str:
    """Why there can be no bag at `path`, a file or a folder; empty where there may be one."""
    try:
        if stat.S_ISDIR(os.stat(path).st_mode):
            found = any(name.endswith((".mcap", ".db3")) for name in os.listdir(path))
            return "" if found else f"{shown(path)} holds no .mcap or .db3 file"
        with open_file(path) as file:
            return "" if file.read(1) else f"{shown(path)} is empty"
    except FileNotFoundError:
        return f"{shown(path)} does not exist"
    except FileError as error:
        return str(error)
    except OSError as error:
        return f"{shown(path)}: {reason_of(error)}"
