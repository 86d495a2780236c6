"""Each table of figures is that of its file, and its file says how it was measured."""

import ast
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import record
import tables

ROOT = Path(__file__).resolve().parent.parent

FILES = tables.files()
NAMES = [file.stem for file in FILES]


@pytest.fixture
def room(tmp_path, monkeypatch):
    """Return a repository of its own: one module, one page, the folder of figures."""
    if not shutil.which("git"):
        pytest.skip("git is not here")
    for module in (record, tables):
        monkeypatch.setattr(module, "ROOT", tmp_path)
        monkeypatch.setattr(module, "FIGURES", tmp_path / "benchmarks" / "figures")
    (tmp_path / "eha_monitor").mkdir()
    (tmp_path / "docs").mkdir()
    (tmp_path / "eha_monitor" / "law.py").write_text('"""Law."""\n\nGAIN = 2.0  # as printed\n')
    (tmp_path / "benchmarks").mkdir()
    (tmp_path / "README.md").write_text("<!-- figures: gain -->\nold\n<!-- /figures -->\n")
    monkeypatch.setattr(sys, "argv", [str(tmp_path / "benchmarks" / "gain.py"), "--record"])
    for words in (["init", "-q"], ["add", "-A"], ["-c", "user.name=a", "-c", "user.email=a@b.c",
                                                  "commit", "-qm", "first"]):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    return tmp_path


def measured(room: Path, **options) -> Path:
    """Record one figure in the repository of its own; returns its file."""
    figures = {"gain": record.spread([3.0, 1.0, 2.0], "m")}
    record.write("gain", figures, ("eha_monitor",), **options)
    (room / "benchmarks/figures/gain.md.j2").write_text("{{ gain.gain | ranged }} m")
    sys.argv[1:] = []  # what is started next is tables.py
    return room / "benchmarks/figures/gain.json"


# ---- this repository ----------------------------------------------------------------------------

@pytest.mark.parametrize("page", tables.pages(), ids=lambda page: page.name)
def test_tables_are_those_of_their_files(page):
    text = page.read_text(encoding="utf-8")
    marks = re.findall(r"^<!-- figures: ", text, re.MULTILINE)
    assert len(marks) == len(tables.MARKED.findall(text)), "a mark without an end or a name"
    if tables.with_tables(text) != text:
        pytest.fail(f"{page.relative_to(ROOT)} differs from benchmarks/figures: run "
                    "`make figures`", pytrace=False)


@pytest.mark.parametrize("file", FILES, ids=NAMES)
def test_a_file_names_a_benchmark_that_records(file):
    made = tables.read(file)
    script = re.match(r"python (benchmarks/\w+\.py)", made["command"])
    if not made.get("copied"):
        assert f'record.write("{file.stem}"' in (ROOT / script[1]).read_text()
        assert made["machine"]["filterpy_steps_per_s"] > 0


# ---- how it is held -----------------------------------------------------------------------------

def test_a_table_is_made_of_its_file(room):
    made = json.loads(measured(room).read_text())
    assert made["figures"]["gain"] == {"value": 2.0, "min": 1.0, "max": 3.0, "n": 3, "unit": "m"}
    assert made["command"] == "python benchmarks/gain.py --record" and not made["dirty"]
    tables.main()
    text = (room / "README.md").read_text()
    assert text == "<!-- figures: gain -->\n2.00 (1.00 to 3.00) m\n<!-- /figures -->\n"
    assert tables.with_tables(text.replace("2.00", "2.50")) == text


def test_what_is_too_old_runs_again(room):
    file = measured(room)
    (room / "benchmarks" / "gain.py").write_text("open('ran', 'w').close()")
    sys.argv[1:] = ["--again"]
    tables.main()
    assert not (room / "ran").exists()
    (room / "eha_monitor" / "law.py").write_text("GAIN = 3.0\n")
    made = file.read_text()
    file.write_text(made.replace('"source"', '"commit"'))
    tables.main()
    assert not (room / "ran").exists()
    file.write_text(made)
    tables.main()
    assert (room / "ran").exists()


def test_a_figure_that_its_file_lacks_is_not_left_out_in_silence(room):
    measured(room)
    (room / "benchmarks/figures/gain.md.j2").write_text("{{ gain.loss | number }}")
    with pytest.raises(Exception, match="loss"):
        tables.main()


def test_code_that_changes_makes_a_figure_old_and_words_do_not(room):
    file, law = measured(room), room / "eha_monitor" / "law.py"
    law.write_text('"""Another word."""\nGAIN = 2.0\n')
    assert tables.too_old(file) == []
    law.write_text("GAIN = 2.1\n")
    assert tables.too_old(file) == [
        "benchmarks/figures/gain.json is older than eha_monitor: run "
        "`python benchmarks/gain.py --record`, then `make figures`"]
    law.write_text("GAIN = 2.0\n")
    (room / "eha_monitor" / "more.py").write_text("")
    assert len(tables.too_old(file)) == 1


def test_the_code_of_a_source_is_what_is_run():
    plain = "class A:\n    def f(self):\n        return 'a'\n"
    words = ('"""M."""\n# c\nclass A:\n    """A."""\n\n    def f(self):\n        "F."\n'
             "        return 'a'  # c\n")
    assert record.code_of(plain) == record.code_of(words)
    assert record.code_of(plain) != record.code_of(plain.replace("'a'", "'b'"))
    assert "type_params" not in record.code_of(ast.unparse(ast.parse(plain)))
