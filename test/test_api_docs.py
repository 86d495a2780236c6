"""The reference is that of the docstrings, and the notebook's figures are those of the program."""

import json
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "scripts"))
LARGEST = 500_000  # bytes of the notebook


def test_the_reference_is_current():
    pytest.importorskip("griffe", reason="griffelib is not installed (extra test)")
    from make_api_reference import page

    import eha_monitor as em

    made = page()
    assert (ROOT / "docs/api.md").read_text(encoding="utf-8") == made, "make reference"
    for name in em.__all__:
        assert f"### `em.{name}`" in made, name


def figures(notebook) -> dict:
    """Return what the last cell prints."""
    return json.loads(notebook.cells[-1].outputs[0].text)


@pytest.mark.timeout(300)
def test_the_notebook_executes_to_the_figures_that_it_shows():
    nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed (extra test)")
    from make_notebook import NOTEBOOK, executed

    assert NOTEBOOK.stat().st_size < LARGEST
    shown = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(shown)
    code = [cell for cell in shown.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    now = executed(NOTEBOOK)
    before, after = figures(shown), figures(now)
    # What is known of the two recordings, whatever the program says.
    assert (after["verdict"], after["effects"]) == ("mismatch", ["coulomb_friction"])
    assert after["F_c"] == pytest.approx(40.0, rel=0.01)
    assert after["B_after"] == pytest.approx(600.0, rel=0.01)
    assert after["B_completed"] == pytest.approx(600.0, rel=0.01)
    assert after["study"] == pytest.approx([300.0, 600.0, 1200.0], abs=0.5)
    for key in ("F_c", "B_before", "B_after", "B_completed", "beta_e_with_air", "study"):
        assert after[key] == pytest.approx(before[key], rel=2e-3), f"{key}: make notebook"
    kinds = [[sorted(output.get("data", {"text": ""})) for output in cell.outputs]
             for cell in shown.cells if cell.cell_type == "code"]
    assert kinds == [[sorted(output.get("data", {"text": ""})) for output in cell.outputs]
                     for cell in now.cells if cell.cell_type == "code"]
    assert sum(["image/png", "text/plain"] in kind for kind in kinds) == 3  # pictures
