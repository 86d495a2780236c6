"""Execute docs/notebook.ipynb anew, in place; what its cells say stays.

    python scripts/make_notebook.py [FILE]

FILE is where the executed notebook goes instead.
"""

import os
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
NOTEBOOK = ROOT / "docs" / "notebook.ipynb"
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
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else NOTEBOOK
    nbformat.write(executed(NOTEBOOK), target)
    print(f"{target}: {target.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
