"""The reference is that of the docstrings, and the notebook's figures are those of the program."""

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
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


def notebook():
    """Return the notebook as it is kept."""
    nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed (extra test)")
    from make_notebook import NOTEBOOK

    assert NOTEBOOK.stat().st_size < LARGEST
    shown = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(shown)
    return NOTEBOOK, shown


def kinds_of(made) -> list:
    """Return what each cell of code has put out."""
    return [[sorted(output.get("data", {"text": ""})) for output in cell.outputs]
            for cell in made.cells if cell.cell_type == "code"]


def test_the_notebook_is_kept_whole_and_its_code_is_that_of_the_package():
    """Each cell was executed, in order, and each name that it takes of the package exists."""
    import eha_monitor as em

    _, shown = notebook()
    code = [cell for cell in shown.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    taken = {name for cell in code for name in re.findall(r"\bem\.(\w+)", cell.source)}
    assert taken and taken <= set(em.__all__)
    assert figures(shown)["effects"] == ["coulomb_friction"]
    assert sum(["image/png", "text/plain"] in kind for kind in kinds_of(shown)) == 3  # pictures


def test_the_notebook_of_a_real_machine_is_kept_whole():
    nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed (extra test)")
    from make_notebook import REAL

    assert REAL.stat().st_size < LARGEST
    shown = nbformat.read(REAL, as_version=4)
    code = [cell for cell in shown.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert sum(["image/png", "text/plain"] in kind for kind in kinds_of(shown)) == 4
    said = "".join(output.get("text", "") for cell in code for output in cell.outputs)
    assert re.search(r"Coulomb friction .* 25\d ± \d+ N·m, where 15 healthy", said)


# A diagnosis, a study and a report: what the docstrings' examples run in test_api_examples.py.
@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_notebook_executes_to_the_figures_that_it_shows():
    from make_notebook import executed

    place, shown = notebook()
    now = executed(place)
    before, after = figures(shown), figures(now)
    # What is known of the two recordings, whatever the program says.
    assert (after["verdict"], after["effects"]) == ("mismatch", ["coulomb_friction"])
    assert after["F_c"] == pytest.approx(40.0, rel=0.01)
    assert after["B_after"] == pytest.approx(600.0, rel=0.01)
    assert after["B_completed"] == pytest.approx(600.0, rel=0.01)
    assert after["study"] == pytest.approx([300.0, 600.0, 1200.0], abs=0.5)
    for key in ("F_c", "B_before", "B_after", "B_completed", "beta_e_with_air", "study"):
        assert after[key] == pytest.approx(before[key], rel=2e-3), f"{key}: make notebook"
    assert kinds_of(shown) == kinds_of(now)
