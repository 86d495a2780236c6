"""Every file that the fuzzer found worth keeping (benchmarks/fuzz_readers.py), replayed."""

from pathlib import Path

import pytest
from corpus_tools import replay_of

CORPUS = Path(__file__).parent / "corpus"
TARGETS = sorted(path.name for path in CORPUS.iterdir())


@pytest.mark.parametrize("target", TARGETS)
def test_a_recording_or_one_line(target, tmp_path):
    replay = replay_of(target, tmp_path)
    files = sorted((CORPUS / target).iterdir())
    assert files
    for path in files:
        try:
            replay(path.read_bytes())
        except BaseException as problem:
            raise AssertionError(f"{path.name}: {problem!r}") from problem


def test_the_corpus_stays_small():
    assert sum(path.stat().st_size for path in CORPUS.rglob("*") if path.is_file()) < 200_000
