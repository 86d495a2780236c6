"""Compiled functions: numba with a cache on disk that cannot go stale.

numba's own cache looks only at the file of the outermost function; a change in an inlined
callee is missed.  Here the cache folder carries a hash of every source file of the package,
so changed physics is always compiled anew, and a read-only installation works too.

numba keys its cache by the absolute path of the source file, so a checkout and the package that
was installed from it would each compile for themselves, and keeps one index for each function,
which two processes overwrite for each other.  Here a file is one function for one signature,
named by module, line and a digest of all that its machine code depends on, without an index.
"""

import contextlib
import hashlib
import json
import os
import pickle
import re
import sys
import tempfile
import threading
import time
import warnings
from pathlib import Path

import numba
from numba.core import caching, event, types
from numba.core.registry import CPUDispatcher, cpu_target
from numba.core.runtime import rtsys

PACKAGE = Path(__file__).parent
DIGEST = 32  # bytes of the content's digest, ahead of it


class _Locator(caching._CacheLocator):
    """The place of a function: its module's name inside the package."""

    def __init__(self, folder: Path, py_func):
        self._py_file = py_func.__code__.co_filename
        module = ".".join(Path(self._py_file).relative_to(PACKAGE).with_suffix("").parts)
        self._folder, self._line = folder / module, py_func.__code__.co_firstlineno

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._folder.parent.name  # the folder is that of exactly this source

    def get_disambiguator(self) -> str:
        return str(self._line)


class _Impl(caching.CompileResultCacheImpl):
    """numba's own reading and writing of a compiled function, at our place."""

    def __init__(self, folder: Path, py_func):
        self._lineno = py_func.__code__.co_firstlineno
        self._locator = _Locator(folder, py_func)
        self._filename_base = self.get_filename_base(
            py_func.__qualname__, getattr(sys, "abiflags", ""))


class _Files:
    """One file for each signature of a function; read from any place, written to the first."""

    def __init__(self, places: tuple[Path, ...], module: str, base: str):
        self._folders, self._base = [place / module for place in places], base

    def _name(self, key: tuple) -> str:
        made_by = (numba.__version__, sys.implementation.cache_tag, key)
        return f"{self._base}-{hashlib.sha256(repr(made_by).encode()).hexdigest()[:16]}.nbc"

    def load(self, key: tuple):
        """Return what was saved under ``key``, or None; what is damaged is as good as absent."""
        name = self._name(key)
        for folder in self._folders:
            try:
                raw = (folder / name).read_bytes()
            except OSError:
                continue
            if hashlib.sha256(raw[DIGEST:]).digest() == raw[:DIGEST]:
                return pickle.loads(raw[DIGEST:])
        return None

    def save(self, key: tuple, data) -> None:
        """Write the file whole or not at all."""
        content = caching.dumps(data)
        handle, name = tempfile.mkstemp(suffix=".tmp", dir=self._folders[0])
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(hashlib.sha256(content).digest() + content)
            os.chmod(name, 0o644)  # whoever may read the package may read this
            os.replace(name, self._folders[0] / self._name(key))
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise

    def flush(self) -> None:
        """Do nothing: other source has another folder."""


class SharedCache(caching.FunctionCache):
    """The cache of one function, shared by every copy of the package with the same source.

    Parameters
    ----------
    py_func : the function, from a file of the package.
    places : folders of exactly this source (:func:`places`).
    """

    def __init__(self, py_func, places: tuple[Path, ...]):
        self._name, self._py_func = repr(py_func), py_func
        self._impl = _Impl(places[0], py_func)
        self._cache_path = self._impl.locator.get_cache_path()
        self._cache_file = _Files(places, Path(self._cache_path).name, self._impl.filename_base)
        self.enable()

    def load_overload(self, sig, target_context):
        """Load a function, and not all that numba can compile: half a second of imports."""
        rtsys.initialize(target_context)  # the reference counts of arrays
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)

    @contextlib.contextmanager
    def _guard_against_spurious_io_errors(self):
        # A disk that is full or read-only costs the next process its time, nobody an answer.
        with contextlib.suppress(OSError):
            yield


def places(source: str) -> tuple[Path, ...]:
    """Return where compiled functions of this source may lie; the first is written to.

    The user's own cache, then what the set-up put beside the installed package: a service runs
    as another user, whose home is empty.

    Parameters
    ----------
    source : digest of the source; the name of the folder is made of it.
    """
    name = f"numba-{source}"
    return (_writable() / name, shipped() / name)


def shipped() -> Path:
    """Return the folder of the environment that holds what the set-up compiled."""
    return Path(sys.prefix) / "share" / "eha_monitor" / "compiled"


def _writable() -> Path:
    base = Path(os.environ.get("EHA_MONITOR_CACHE") or os.path.join(
        os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "eha_monitor"))
    with contextlib.suppress(OSError):
        base.mkdir(parents=True, exist_ok=True)
        if os.access(base, os.W_OK):
            return base
    # No home to write to.  Code is loaded from there, so it must be a folder of nobody else.
    folder = Path(tempfile.gettempdir()) / f"eha_monitor-{os.getuid()}"
    with contextlib.suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        if found.st_uid == os.getuid() and not found.st_mode & 0o022 and not folder.is_symlink():
            return folder
    return Path(tempfile.mkdtemp(prefix="eha_monitor-"))


class Announcer(event.Listener):
    """Says in one line that compilation begins, before the silence, whoever asked for it."""

    SECONDS = 40  # of processor, for all that `estimate` needs, on a busy machine
    MORE = 40  # and for what only a diagnosis or its advice needs

    def __init__(self, place: Path):
        self.quiet = False
        self._place = place
        self._said: set[str] = set()
        self._lock = threading.Lock()

    def on_start(self, event) -> None:
        """Tell of the first function of each part of the program that is compiled."""
        module = event.data["dispatcher"].py_func.__module__ or ""
        if not module.startswith("eha_monitor."):
            return
        part = ("the diagnosis" if re.match(r"eha_monitor\.(mismatch|concealed)\.", module)
                else "the model")
        with self._lock:
            if self.quiet or part in self._said:
                return
            self._said.add(part)
        seconds = self.MORE if part == "the diagnosis" else self.SECONDS
        print(f"eha_monitor: compiling {part} once (up to {seconds} s of processor) into "
              f"{self._place} ...", file=sys.stderr, flush=True)

    def on_end(self, event) -> None:
        """Say nothing: the answer follows."""


class Listed(event.Listener):
    """Adds a line of JSON to a file for each function that is compiled, when it is done.

    A line is [depth, module, function, seconds of processor in this thread, types, the command];
    depth 0 was called from Python, a deeper one by what was being compiled.
    """

    def __init__(self, file: Path):
        self._file, self._begun = file, threading.local()

    def on_start(self, event) -> None:
        """Start the clock."""
        self._begun.__dict__.setdefault("stack", []).append(time.thread_time())

    def on_end(self, event) -> None:
        """Write the line."""
        seconds = time.thread_time() - self._begun.stack.pop()
        function = event.data["dispatcher"].py_func
        line = json.dumps([len(self._begun.stack), function.__module__, function.__qualname__,
                           round(seconds, 3), written(event.data["args"]), sys.argv])
        with open(self._file, "a", encoding="utf-8") as file:
            file.write(line + "\n")


def written(given: tuple | types.Type) -> str:
    """Return types as ``signatures.json`` has them."""
    if isinstance(given, tuple):
        return f"({', '.join(map(written, given))}{',' * (len(given) == 1)})"
    if isinstance(given, types.BaseNamedTuple):
        made = given.instance_class
        return f"named({made.__module__!r}, {made.__name__!r}, {', '.join(map(written, given))})"
    if isinstance(given, types.Array) and given.ndim and given.mutable and given.aligned:
        places = [":"] * given.ndim
        if given.layout in "CF":
            places[-1 if given.layout == "C" else 0] = "::1"
        return f"{written(given.dtype)}[{', '.join(places)}]"
    if isinstance(given, types.Array):
        return (f"Array({written(given.dtype)}, {given.ndim}, {given.layout!r}, "
                f"readonly={not given.mutable}, aligned={given.aligned})")
    if isinstance(given, types.UniTuple):
        return f"UniTuple({written(given.dtype)}, {given.count})"
    return str(given)


def announce(place: Path) -> Announcer:
    """Tell from now on when something is compiled into ``place``.

    ``EHA_MONITOR_COMPILED`` names a file that keeps a list (:class:`Listed`).
    """
    announcer = Announcer(place)
    event.register("numba:compile", announcer)
    if file := os.environ.get("EHA_MONITOR_COMPILED"):
        event.register("numba:compile", Listed(Path(file)))
    return announcer


_IMPORTS = re.compile(rb"^\s*from eha_monitor\.([\w.]+) import (\([^)]*\)|.*)$", re.MULTILINE)
_CONSTANT = re.compile(rb"\b[A-Z][A-Z0-9_]*\b")


def _source_hash() -> str:
    root = Path(__file__).parent
    digest = hashlib.sha256()
    digest.update(Path(__file__).read_bytes())  # the options are here
    sources = {path: path.read_bytes()
               for folder in ("physics", "estimation", "recordings", "mismatch", "concealed")
               for path in (root / folder).rglob("*.py")}
    # What is compiled, physics with its constants, and where these have constants from: a constant
    # is part of the compiled code, a function that is not compiled is not.
    wanted = [path for path, source in sources.items()
              if b"njit" in source or path.is_relative_to(root / "physics")]
    taken: set[Path] = set()
    while wanted:
        path = wanted.pop()
        if path in taken or path not in sources:
            continue
        taken.add(path)
        for module, names in _IMPORTS.findall(sources[path]):
            place = root / module.decode().replace(".", "/")
            wanted += [place.with_suffix(".py")] if _CONSTANT.search(names) else []
            wanted += [place / f"{name.decode()}.py" for name in re.findall(rb"\w+", names)]
    for path in sorted(taken):
        digest.update(str(path.relative_to(root)).encode() + sources[path])
    return digest.hexdigest()[:16]


PLACES = places(_source_hash())
CACHE = PLACES[0]
FIRST_RUN = not any(place.exists() for place in PLACES)
ANNOUNCER = announce(CACHE)

# The catalogue calls its terms through a tuple of functions: works, cached, "experimental".
warnings.filterwarnings("ignore", category=numba.core.errors.NumbaExperimentalFeatureWarning)
literal_unroll = numba.literal_unroll


def njit(function=None, *, cache: bool = True, allocates: bool = True, **options):
    """``numba.njit`` with the cache on, usable with and without arguments.

    A function that neither makes nor returns an array may say so: ``allocates=False``.  It then
    counts no references to the arrays it is given (its caller holds them), nor to views of them.
    Each count is an atomic instruction: in a step of a small filter they took two thirds of the
    time.  A function that says so and makes an array, or returns one, is refused.
    """
    options.setdefault("error_model", "numpy")
    # Fused multiply-add and reciprocals; NaN keeps its meaning (it marks what is missing).
    options.setdefault("fastmath", {"contract", "arcp"})
    if function is None:
        return lambda inner: njit(inner, cache=cache, allocates=allocates, **options)
    # Always given: else a function takes it from whichever caller has it compiled first.
    made = numba.njit(function, _nrt=allocates, **options)
    if isinstance(made, CPUDispatcher):  # NUMBA_DISABLE_JIT: the function itself
        made.get_call_template = _whatever_the_value(made.get_call_template)
        if not allocates:
            made.add_overload = _without_an_array(made.add_overload)
    # A function of somebody else's file is kept by nobody: the folder is named by our source.
    ours = Path(function.__code__.co_filename).is_relative_to(PACKAGE)
    if cache and ours and isinstance(made, CPUDispatcher):
        made._cache = SharedCache(function, PLACES)
    return made


def _whatever_the_value(template):
    """Let a call with a constant, as in ``f(x, True)``, take the code of any value.

    numba compiles a function anew for each constant that a caller passes.  What is written into
    its caller knows the constant all the same.
    """
    def plain(args, kws):
        return template(tuple(types.unliteral(given) for given in args),
                        {name: types.unliteral(given) for name, given in kws.items()})
    return plain


def _without_an_array(add):
    """Refuse an array that a function returns uncounted: its caller would free it once more."""
    def checked(compiled):
        returned = cpu_target.target_context.data_model_manager[compiled.signature.return_type]
        if returned.contains_nrt_meminfo():
            raise TypeError(f"{compiled.fndesc.qualname} returns an array: it may not say "
                            "allocates=False")
        add(compiled)
    return checked


def load_runtime() -> None:
    """Start what compiled functions run on, so that it counts as start and not as an answer."""
    from numba.core.runtime import rtsys

    rtsys.initialize(cpu_target.target_context)
