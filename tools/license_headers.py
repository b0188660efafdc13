# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Put copyright and licence at the head of every source file that has none: python tools/license_headers.py [--check].

With --check files without them are named and nothing is written; exit code 1 if there are any.
"""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
LINES = ("Copyright 2026 fdi_ros maintainers", "SPDX-License-Identifier: Apache-2.0")
COMMENTS = {
    ".py": ("# ", ""),
    ".sh": ("# ", ""),
    ".js": ("// ", ""),
    ".css": ("/* ", " */"),
}
"""What a line of comment begins and ends with, by the suffix of a file."""
BUILT = {"build", "dist", "install", "log", "__pycache__"}


def header(suffix: str) -> str:
    """Lines for a file with this suffix."""
    begin, end = COMMENTS[suffix]
    return "".join(f"{begin}{line}{end}\n" for line in LINES)


def with_header(text: str, suffix: str) -> str:
    """Text of a file with the header on top, below the line that names an interpreter."""
    shebang, rest = text.split("\n", 1) if text.startswith("#!") else ("", text)
    first = f"{shebang}\n" if shebang else ""
    gap = "\n" if rest and not rest.startswith("\n") else ""
    return f"{first}{header(suffix)}{gap}{rest}"


def sources() -> Iterator[Path]:
    """Source files of the repository, what is built or installed in it left out."""
    for folder, folders, names in os.walk(ROOT):
        folders[:] = [
            name for name in folders if name not in BUILT and not name.startswith(".")
        ]
        yield from (
            Path(folder) / name for name in names if Path(name).suffix in COMMENTS
        )


def lacking() -> list[Path]:
    """Source files without the header."""
    return sorted(
        path
        for path in sources()
        if header(path.suffix) not in path.read_text(encoding="utf-8")
    )


def main() -> int:
    """Mend or name the files."""
    paths = lacking()
    for path in paths:
        print(path.relative_to(ROOT))
        if "--check" not in sys.argv:
            path.write_text(
                with_header(path.read_text(encoding="utf-8"), path.suffix),
                encoding="utf-8",
            )
    return 1 if paths and "--check" in sys.argv else 0


if __name__ == "__main__":
    sys.exit(main())
