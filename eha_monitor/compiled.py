"""Compiled functions: numba with a cache on disk that cannot go stale.

numba's own cache looks only at the file of the outermost function; a change in an inlined
callee is missed.  Here the cache folder carries a hash of every source file of the package,
so changed physics is always compiled anew, and a read-only installation works too.
"""

import hashlib
import os
import re
import sys
import tempfile
import warnings
from pathlib import Path


def _source_hash() -> str:
    root = Path(__file__).parent
    digest = hashlib.sha256()
    digest.update(Path(__file__).read_bytes())  # the options are here
    sources = {path: path.read_bytes()
               for folder in ("physics", "filters", "recordings", "mismatch", "concealed")
               for path in (root / folder).rglob("*.py")}
    # What is compiled, physics with its constants, and what these import: a constant from
    # anywhere is part of the compiled code.
    wanted = [path for path, source in sources.items()
              if b"njit" in source or path.is_relative_to(root / "physics")]
    taken: set[Path] = set()
    while wanted:
        path = wanted.pop()
        if path in taken or path not in sources:
            continue
        taken.add(path)
        wanted += [root / f"{name.decode().replace('.', '/')}.py"
                   for name in re.findall(rb"^\s*from eha_monitor\.([\w.]+) import", sources[path],
                                          re.MULTILINE)]
    for path in sorted(taken):
        digest.update(str(path.relative_to(root)).encode() + sources[path])
    return digest.hexdigest()[:16]


def cache_directory() -> Path:
    """Return the folder of the compiled functions of exactly this source."""
    base = os.environ.get("EHA_MONITOR_CACHE") or os.path.join(
        os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "eha_monitor"
    )
    wanted = Path(base) / f"numba-{_source_hash()}"
    try:
        Path(base).mkdir(parents=True, exist_ok=True)
        if os.access(base, os.W_OK):
            return wanted
    except OSError:
        pass
    return Path(tempfile.gettempdir()) / "eha_monitor" / wanted.name  # no home to write to


CACHE = cache_directory()
FIRST_RUN = not CACHE.exists()
os.environ.setdefault("NUMBA_CACHE_DIR", str(CACHE))

import numba  # noqa: E402  the cache folder must be known before the import

# The catalogue calls its terms through a tuple of functions: works, cached, "experimental".
warnings.filterwarnings("ignore", category=numba.core.errors.NumbaExperimentalFeatureWarning)
numba.config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"]
literal_unroll = numba.literal_unroll


def njit(function=None, **options):
    """``numba.njit`` with the cache on, usable with and without arguments."""
    options.setdefault("cache", True)
    options.setdefault("error_model", "numpy")
    # Fused multiply-add and reciprocals; NaN keeps its meaning (it marks what is missing).
    options.setdefault("fastmath", {"contract", "arcp"})
    if function is None:
        return lambda inner: numba.njit(inner, **options)
    return numba.njit(function, **options)


def announce_first_compilation() -> None:
    """Say once, on a terminal, why the first run takes half a minute longer."""
    if FIRST_RUN and sys.stderr.isatty():
        print(f"compiling the model once into {CACHE} ...", file=sys.stderr)


def load_runtime() -> None:
    """Load what numba otherwise imports at the first call (0.4 s), so that it counts as start."""
    from numba.core.registry import cpu_target

    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()
