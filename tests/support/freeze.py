"""The frozen world: a dataset, a run and a scene as a zip, which changes when a format's version does.

`PYTHONPATH=.:tests python tests/support/freeze.py FILE.zip` makes it; once for each version of the formats.
"""

import sys
import tempfile
import zipfile
from pathlib import Path


def main() -> None:
    from support.disk import read_state
    from support.hostile import write_world

    with tempfile.TemporaryDirectory() as folder:
        write_world(Path(folder))
        files = read_state(Path(folder)).files
    with zipfile.ZipFile(sys.argv[1], "w", zipfile.ZIP_DEFLATED) as archive:
        for path, data in sorted(files.items()):
            # A fixed time: the same files are the same zip.
            archive.writestr(zipfile.ZipInfo(path, (2026, 1, 1, 0, 0, 0)), data, zipfile.ZIP_DEFLATED)


if __name__ == "__main__":
    main()
