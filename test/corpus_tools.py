"""One input of the fuzzer through the reader that it is for: a recording, or one line."""

from collections.abc import Callable
from pathlib import Path

from bag_tools import contract_messages, write_mcap

from eha_monitor.errors import InputError
from eha_monitor.recordings.bag import iter_raw, topics
from eha_monitor.recordings.importing import import_file, read_table
from eha_monitor.recordings.read import read_recording
from eha_monitor.settings import Settings, load_settings, settings_from_tree

DEFAULT = Settings()
COLUMNS = settings_from_tree({"table": {"time": "0", "columns": {
    "x": {"column": "1"}, "p1": {"column": "2"}}}}, "map")
NAMED = settings_from_tree({"table": {"time": "t", "columns": {
    "x": {"column": "x"}, "p1": {"column": "p[:,0]"}}}}, "map")


def _checked(work: Callable[[], object]) -> None:
    try:
        work()
    except InputError as problem:
        text = str(problem)
        assert text and "\n" not in text and len(text) < 2000, text


def replay_of(target: str, folder: Path) -> Callable[[bytes], None]:
    """Return what takes an input of a target; anything but InputError comes through."""
    def mcap(data: bytes) -> None:
        path = folder / "a.mcap"
        path.write_bytes(data)
        for work in (lambda: read_recording(path, DEFAULT), lambda: list(iter_raw(path)),
                     lambda: topics(path)):
            _checked(work)

    def bag(data: bytes) -> None:
        inside = folder / "bag"
        inside.mkdir(exist_ok=True)
        if not (inside / "a_0.mcap").exists():
            write_mcap(inside / "a_0.mcap", contract_messages(5))
        (inside / "metadata.yaml").write_bytes(data)
        _checked(lambda: read_recording(inside, DEFAULT))

    def csv(data: bytes) -> None:
        path = folder / "a.csv"
        path.write_bytes(data)
        _checked(lambda: read_table(path, COLUMNS))

    def mat(data: bytes) -> None:
        path = folder / "a.mat"
        path.write_bytes(data)
        _checked(lambda: read_table(path, NAMED))

    def map_(data: bytes) -> None:
        table = folder / "b.csv"
        if not table.exists():
            table.write_text("time;x;p\n" + "".join(f"{k};{k % 7};{k % 5}\n" for k in range(40)))
        path = folder / "map.yaml"
        path.write_bytes(data)
        _checked(lambda: load_settings(path))
        _checked(lambda: import_file(table, path, folder / "out", overwrite=True))

    return {"mcap": mcap, "bag": bag, "csv": csv, "mat": mat, "map": map_}[target]
