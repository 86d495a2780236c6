"""Compiled functions: numba with a cache on disk that cannot go stale.

numba's own cache looks only at the file of the outermost function; a change in an inlined
callee is missed.  Here the cache folder carries a hash of every source file of the package,
so changed physics is always compiled anew, and a read-only installation works too.
"""

import hashlib
import os
import sys
import tempfile
import warnings
from pathlib import Path


def _source_hash() -> str:
    root = Path(__file__).parent
    digest = hashlib.sha256()
    digest.update(Path(__file__).read_bytes())  # the options are here
    for folder in ("physics", "filters", "recordings", "mismatch", "concealed"):
        for path in sorted((root / folder).rglob("*.py")):
            source = path.read_bytes()
            # What is not compiled has no part in it; these two folders hold constants as well.
            if folder in ("physics", "concealed") or b"njit" in source:
                digest.update(str(path.relative_to(root)).encode())
                digest.update(source)
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
