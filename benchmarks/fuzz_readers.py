"""Coverage-guided fuzzing of the bag reader and the importer, with atheris (libFuzzer).

    pip install atheris
    python benchmarks/fuzz_readers.py --seconds 600

Each target starts from the files in ``test/corpus/<target>`` and small ones made here, runs for
its part of the time, and leaves there those that reach other code than the rest (libFuzzer's
merge).  What raises anything but InputError, with one line, is kept as ``found-*`` and ends the
target: the exit status is 1.  ``test/test_corpus.py`` replays every file, without atheris.
"""

import argparse
import importlib.util
import subprocess
import sys
import tempfile
import time
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
sys.path[:0] = [str(REPOSITORY), str(REPOSITORY / "test")]
CORPUS = REPOSITORY / "test" / "corpus"
TARGETS = ("mcap", "bag", "csv", "mat", "map")
LARGEST = 3000  # bytes of an input; the corpus stays small
INSTRUMENTED = ["eha_monitor.recordings", "eha_monitor.settings", "eha_monitor.units", "mcap",
                "rosbags"]


def main() -> int:
    """Fuzz all targets one after the other; the exit status is 1 if one was broken."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--seconds", type=float, default=60.0, help="for all targets together")
    options.add_argument("--targets", nargs="+", choices=TARGETS, default=list(TARGETS))
    options.add_argument("--child", help=argparse.SUPPRESS)
    given, rest = options.parse_known_args()
    if given.child:
        fuzz(given.child, rest)
        return 0
    if importlib.util.find_spec("atheris") is None:
        print("fuzz_readers: not run, it needs atheris (pip install atheris)")
        return 0
    broken = []
    for target in given.targets:
        folder = CORPUS / target
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as name:
            work = Path(name)
            for place, content in enumerate(seeds(target)):
                (work / f"seed-{place}").write_bytes(content)
            begun = time.monotonic()
            status = child(target, f"-max_total_time={round(given.seconds / len(given.targets))}",
                           f"-artifact_prefix={folder}/found-", str(work), str(folder))
            merged = Path(name + "-merged")
            merged.mkdir()
            child(target, "-merge=1", str(merged), str(folder), str(work))
            keep(merged, folder)
            print(f"{target:5} {time.monotonic() - begun:5.0f} s, exit status {status}, "
                  f"{len(list(folder.iterdir()))} files, "
                  f"{sum(f.stat().st_size for f in folder.iterdir()) / 1000:.1f} kB", flush=True)
        if status:
            broken.append(target)
    return int(bool(broken))


def child(target: str, *arguments: str) -> int:
    """Run libFuzzer on a target in a process of its own; return its exit status."""
    done = subprocess.run(
        [sys.executable, __file__, "--child", target, f"-max_len={LARGEST}", "-timeout=20",
         "-rss_limit_mb=3000", "-verbosity=0", *arguments], cwd=REPOSITORY, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    if done.returncode:
        print(done.stdout[-3000:])
    return done.returncode


def keep(merged: Path, folder: Path, most: int = 35_000) -> None:
    """Put the smallest of the merged files into the corpus, up to ``most`` bytes."""
    for old in folder.glob("[0-9a-f]*"):
        if not old.name.startswith("found-"):
            old.unlink()
    for path in sorted(merged.iterdir(), key=lambda path: path.stat().st_size):
        most -= path.stat().st_size
        if most >= 0:
            (folder / path.name[:16]).write_bytes(path.read_bytes())
        path.unlink()
    merged.rmdir()


def seeds(target: str) -> list[bytes]:
    """Return sound inputs to begin with."""
    import io

    import numpy as np
    from bag_tools import contract_messages, write_mcap

    if target in ("mcap", "bag"):
        found = []
        with tempfile.TemporaryDirectory() as folder:
            for compression, chunked in (("none", True), ("none", False), ("zstd", True)):
                path = write_mcap(Path(folder) / "a.mcap", contract_messages(3),
                                  compression=compression, chunked=chunked, definitions={
                                      "sensor_msgs/msg/JointState": " ",
                                      "sensor_msgs/msg/FluidPressure": " "})
                found.append(path.read_bytes())
        if target == "mcap":
            return found
        metadata = (REPOSITORY / "bags" / "air_ingress" / "metadata.yaml").read_bytes()[:900]
        return [metadata, b"rosbag2_bagfile_information: {relative_file_paths: [a_0.mcap]}"]
    if target == "csv":
        return [b"t,x,p\n0,1,2\n0.001,2,3\n0.002,3,4\n0.003,1,5\n",
                "\ufefft;x;p\n0;1,5;2\n1;2,5;nan\n2;3,5;\n".encode(),
                b"# c\n0\t1\t2\n1\t2\t3\n2\t2\t4\n3\t3\t5\n", b"0 1 2\n1 2 3\n2 3 4\n"]
    if target == "mat":
        from scipy.io import savemat

        found = []
        for packed in (False, True):
            stream = io.BytesIO()
            savemat(stream, {"t": np.arange(5) * 1e-3, "x": np.arange(5.0), "p": np.eye(5)},
                    do_compression=packed)
            found.append(stream.getvalue())
        return found
    return [(REPOSITORY / "config" / name).read_bytes()[:LARGEST]
            for name in ("ivliev_eha.yaml", "emps.yaml", "hanging_load.yaml")]


def fuzz(target: str, arguments: list[str]) -> None:
    """Run libFuzzer in this process."""
    import atheris

    import eha_monitor.recordings.bag  # noqa: F401  compiled: not to be instrumented

    with atheris.instrument_imports(include=INSTRUMENTED):
        import corpus_tools

    folder = tempfile.TemporaryDirectory()
    replay = corpus_tools.replay_of(target, Path(folder.name))

    def one(data: bytes) -> None:
        replay(data)

    # To merge, libFuzzer starts its first argument again, through a shell.
    itself = f"{sys.executable} {Path(__file__).resolve()} --child {target}"
    atheris.Setup([itself, *arguments], one)
    atheris.Fuzz()


if __name__ == "__main__":
    sys.exit(main())
