"""Run every benchmark: `make bench`. Speeds are ratios against a floor or a rival of the same run."""

import importlib.util
import platform
import sys
from pathlib import Path

HERE = Path(__file__).parent


def main() -> int:
    """Run `main()` of each bench_*.py beside this file, in order of their names."""
    print(f"knee_gap benchmarks, Python {platform.python_version()}, {platform.machine()}")
    worst = 0
    for path in sorted(HERE.glob("bench_*.py")):
        print(f"\n== {path.stem.removeprefix('bench_')} ==", flush=True)
        spec = importlib.util.spec_from_file_location(path.stem, path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[path.stem] = module
        spec.loader.exec_module(module)
        worst = max(worst, int(module.main() or 0))
    return worst


if __name__ == "__main__":
    sys.exit(main())
