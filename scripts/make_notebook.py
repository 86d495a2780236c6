"""Execute docs/notebook.ipynb and docs/real_machine.ipynb anew, in place; their cells stay.

    python scripts/make_notebook.py [NOTEBOOK ...]

The second reads recordings beside the repository (docs/real_recordings.md); without them it stays.
"""

import os
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
NOTEBOOK = ROOT / "docs" / "notebook.ipynb"
REAL = ROOT / "docs" / "real_machine.ipynb"
DATA = Path(os.environ.get("EHA_DATA", ROOT.parent / "shared" / "data"))
LONGEST = 300  # s of one cell


def executed(path: Path) -> nbformat.NotebookNode:
    """Return a notebook with the outputs of a fresh kernel, in the folder that it lies in.

    Raises
    ------
    nbclient.exceptions.CellExecutionError
        If a cell fails.
    """
    notebook = nbformat.read(path, as_version=4)
    before = os.environ.get("PYTHONPATH", "")
    with tempfile.TemporaryDirectory() as place:  # no history, no settings of this user
        os.environ |= {"IPYTHONDIR": place, "JUPYTER_RUNTIME_DIR": place,
                       "PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), before)))}
        NotebookClient(notebook, timeout=LONGEST, kernel_name="python3", record_timing=False,
                       resources={"metadata": {"path": str(path.parent)}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
    notebook.metadata["language_info"] = {"name": "python"}  # not of this very Python
    return notebook


def main() -> None:
    """Execute and write."""
    os.environ["EHA_DATA"] = str(DATA.resolve())
    for path in [Path(name).resolve() for name in sys.argv[1:]] or [NOTEBOOK, REAL]:
        if path == REAL and not (DATA / "flo_tork").exists():
            print(f"{path}: left as it is, {DATA / 'flo_tork'} is not here")
            continue
        nbformat.write(executed(path), path)
        print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
