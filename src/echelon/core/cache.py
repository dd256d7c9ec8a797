"""Results that are computed once: in memory, and on disk for later runs of the command line.

A key on disk covers everything that determines a result: echelon's source, the versions of its
dependencies, the machine, the settings of JAX and the arguments. Nothing is stored for a value of a
foreign class, since such a class may read anything. A stored result is therefore what the current
sources would compute. The folder must be one that only its user can change: machine code and
pickles that are read from it are run.
"""

import contextlib
import functools
import hashlib
import importlib.util
import io
import os
import pickle
import platform
import stat
import sys
import tempfile
import threading
import time
import warnings
import zlib
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, MutableMapping
from pathlib import Path
from typing import Any, Final, Generic, ParamSpec, TypeVar, final

from echelon.core.identity import digest, process_key

_P = ParamSpec("_P")
_R = TypeVar("_R")
_V = TypeVar("_V")

MOST: Final = 256
"""Results cached in memory per function: a sweep over parameters must not fill it."""
_LIMIT: Final = 256 * 2**20
"""Bytes on disk: 500 scenarios of the paper's size. JAX's own limit would need `filelock`."""
_OF_JAX: Final = {
    # By default JAX stores only code that took a second to compile: 1 of 24 pieces of `run paper`.
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
}
_SETTINGS, _IDLE = ("xla_", "jax_"), ("cache", "log")
"""Prefixes of settings that may change compiled code; words in names of settings that do not."""
BEGAN = time.time() - 1.0
"""Start of this process, s, less a margin: file clocks are coarse, some modules load earlier."""
_folder: Path | None = None
_closed = threading.Event()


# ---- in memory -----------------------------------------------------------------------------------


@final
class BoundedCache(Generic[_V]):
    """A bounded cache that drops the least recently used value.

    Args:
        most: largest number of values.
        size: function that returns the size of a value, such as its bytes.
        room: largest total size.
    """

    def __init__(
        self, most: int, size: Callable[[_V], int] | None = None, room: int = sys.maxsize
    ) -> None:
        self._most, self._size, self._room = most, size, room
        self._values: OrderedDict[Hashable, _V] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._values)

    def get_or_make(self, key: Hashable | None, make: Callable[[], _V]) -> _V:
        """Return the value of a key, or make and store it; without a key it is always made."""
        if key is not None:
            with self._lock:
                if key in self._values:
                    self._values.move_to_end(key)
                    return self._values[key]
        # Outside the lock, since `make` may take long and other threads would wait.
        value = make()
        if key is not None:
            self.put(key, value)
        return value

    def pop(self, key: Hashable) -> _V | None:
        """Remove and return the value of a key; None if there is none."""
        with self._lock:
            return self._values.pop(key, None)

    def put(self, key: Hashable, value: _V) -> None:
        """Store a value as the most recently used one."""
        with self._lock:
            self._values[key] = value
            self._values.move_to_end(key)
            while len(self._values) > self._most or self.total() > self._room:
                self._values.popitem(last=False)

    def total(self) -> int:
        """Return the size of all values together."""
        # Recomputed each time, since stored values may grow.
        return 0 if self._size is None else sum(map(self._size, self._values.values()))


def memoize(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function that computes once per argument values.

    Arguments are compared bit by bit, since arrays can be changed in place. Without a hash of its
    arguments, a result is computed each time. Results are shared between callers, so they must be
    read-only.
    """
    name, results = f"{function.__module__}.{function.__qualname__}", BoundedCache[_R](MOST)

    @functools.wraps(function)
    def once(*args: _P.args, **named: _P.kwargs) -> _R:
        def compute() -> _R:
            return load_or_compute(lambda: function(*args, **named), name, args, named)

        return results.get_or_make(process_key((args, named)), compute)

    return once


# ---- on disk -------------------------------------------------------------------------------------


def load_or_compute(
    compute: Callable[[], _R],
    what: str,
    *values: object,
    unpack: Callable[[bytes], _R] = pickle.loads,
    pack: Callable[[_R], bytes] | None = None,
) -> _R:
    """Return a result for some values, from the disk cache if another process computed it.

    Args:
        compute: function that computes it.
        what: its name.
        values: trees of numbers, arrays, strings and echelon's own classes.
        unpack: function that makes the result from bytes.
        pack: function that makes bytes from the result; None to pickle it.
    """
    file = file_for(what, *values)
    if file is None:
        return compute()
    # Any failure of the cache is harmless: the result is then computed.
    with contextlib.suppress(Exception):
        packed = _read(file)
        if packed is not None:
            return unpack(packed)
    result = compute()
    with contextlib.suppress(Exception):
        # A module that is imported late may have changed since the digest was taken.
        if sources() == loaded_sources():
            _write(file, (pack or _pickled)(result))
    return result


def file_for(what: str, *values: object) -> Path | None:
    """Return the file for a result of some values; None if it may not be stored."""
    common = ground() if is_open() else None
    identity = None if common is None else digest((what, jax_settings(), values))
    if _folder is None or common is None or identity is None:
        return None
    return _folder / f"{hashlib.sha256(common + identity).hexdigest()}-made-cache"


def load_or_compile(compile_text: Callable[[], bytes], *parts: str) -> bytes:
    """Return machine code, stored beside JAX's own if only the user can change that folder.

    Args:
        compile_text: function that compiles it.
        parts: all that it depends on: the text, the compiler, the processor.
    """
    import jax

    folder = _private(getattr(jax.config, "jax_compilation_cache_dir", None) or "")
    if folder is None:
        return compile_text()
    file = folder / f"{hashlib.sha256(chr(0).join(parts).encode()).hexdigest()}-native-cache"
    code = _read(file)
    if code is None:
        code = compile_text()
        _write(file, code)
    return code


@contextlib.contextmanager
def use_folder(folder: Path | None) -> Iterator[None]:
    """Cache in a folder, or not at all, within the context and in this process only.

    Only the command line opens one: a program that imports echelon may modify its classes.
    """
    global _folder
    before, _folder = _folder, folder
    try:
        yield
    finally:
        _folder = before


def is_open() -> bool:
    """Return whether the cache is open in this process."""
    return not _closed.is_set() and _folder is not None


def close() -> None:
    """Stop reading and writing, since a user's file may have changed the code that runs."""
    _closed.set()


def open_user_folder(environment: MutableMapping[str, str]) -> Path | None:
    """Let JAX store compiled code in the folder of `user_folder`, and return that folder.

    JAX reads the environment when it is imported, so this needs no JAX. Nothing is changed, and
    None returned, if the folder cannot be made, if others can change it, or if the user has set
    JAX's own variable.
    """
    folder = user_folder(environment)
    if folder is None or "JAX_COMPILATION_CACHE_DIR" in environment:
        return None
    try:
        folder = private_folder(folder)
        remove_oldest(folder)
    except OSError:
        return None
    environment["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    for name, value in _OF_JAX.items():
        environment.setdefault(name, value)
    # A full disk or a truncated entry: JAX compiles again, and the run is the same.
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry")
    return folder


def user_folder(environment: MutableMapping[str, str]) -> Path | None:
    """Return the folder `ECHELON_CACHE` or one of the user's caches; None if `off`, or no home."""
    setting = environment.get("ECHELON_CACHE")
    if setting in ("", "off"):
        return None
    try:
        if setting:
            home = Path(setting).expanduser()
        elif sys.platform == "win32":
            local = environment.get("LOCALAPPDATA")
            home = Path(local or Path.home() / "AppData" / "Local") / "echelon"
        elif sys.platform == "darwin":
            home = Path.home() / "Library" / "Caches" / "echelon"
        else:
            home = Path(environment.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "echelon"
    except RuntimeError:  # pathlib's error for a user without a home, as in some containers
        return None
    return home.absolute() / "compiled"


def private_folder(path: Path) -> Path:
    """Return a folder with all links on the way resolved; it is created if it is missing.

    Raises:
        OSError: it cannot be created, or is a link.
        PermissionError: somebody else can change it or a folder above it.
    """
    if path.is_symlink():
        raise NotADirectoryError(f"`{path}` is a link")
    for folder in (*reversed(path.parents), path):
        if not folder.exists():
            folder.mkdir(0o700, exist_ok=True)
    path = path.resolve()
    if sys.platform == "win32":
        # A folder inside a user's folder is the user's.
        return path
    # From the root down, so that nobody can replace what was checked, nor what is below it.
    for folder in (*reversed(path.parents), path):
        status = folder.lstat()
        mode, own = status.st_mode, status.st_uid == os.geteuid()
        # In a folder such as /tmp nobody can rename what belongs to another user.
        closed = not mode & 0o022 or bool(mode & stat.S_ISVTX) and folder != path
        if not (stat.S_ISDIR(mode) and (own or status.st_uid == 0 and folder != path) and closed):
            raise PermissionError(f"somebody else can change `{folder}`")
        if own and not mode & 0o077:
            # Nobody else can enter it, so modes below it do not count.
            break
    return path


def jax_settings() -> tuple[str, ...]:
    """Return the settings of this thread that may change what JAX compiles."""
    # Imported here, since the command line opens the cache before it needs JAX.
    import jax

    # Some settings have no value per thread.
    of_all = jax.config.values
    return tuple(f"{name}={getattr(jax.config, name, of_all[name])}" for name in _switches())


@functools.cache
def _private(path: str) -> Path | None:
    try:
        return private_folder(Path(path).absolute()) if path else None
    except OSError:
        return None


def remove_oldest(folder: Path, left: int = _LIMIT) -> None:
    """Remove the oldest files of the cache until the rest has at most `left` bytes."""
    files = [(file, file.lstat()) for file in folder.glob("*-cache")]
    for file, status in sorted(files, key=lambda pair: pair[1].st_mtime, reverse=True):
        left -= status.st_size
        if left < 0:
            file.unlink(missing_ok=True)


def _read(file: Path) -> bytes | None:
    """Return the content of a file; None if it is missing or damaged."""
    with contextlib.suppress(OSError, zlib.error):
        stored = file.read_bytes()
        # Damaged machine code would crash the process.
        if hashlib.sha256(stored[32:]).digest() == stored[:32]:
            return zlib.decompress(stored[32:])
    return None


def _write(file: Path, content: bytes) -> None:
    """Write a file for `_read` completely or not at all; a full disk is ignored."""
    packed = zlib.compress(content, 1)
    with contextlib.suppress(OSError):
        # With this ending the cleanup finds the file if this process is killed before the rename.
        handle, part = tempfile.mkstemp("-cache", dir=file.parent)
        try:
            with os.fdopen(handle, "wb") as stream:
                stream.write(hashlib.sha256(packed).digest() + packed)
            os.replace(part, file)
        except BaseException:
            os.unlink(part)
            raise


class _Pickler(pickle.Pickler):
    """Pickles arrays so that they come back read-only, as results are shared."""

    def reducer_override(self, value: Any) -> Any:
        if type(value).__name__ != "ndarray" or value.dtype.hasobject:
            return NotImplemented
        return _array, (value.tobytes(), value.dtype, value.shape)


def _array(content: bytes, dtype: Any, shape: tuple[int, ...]) -> Any:
    import numpy as np

    return np.frombuffer(content, dtype).reshape(shape)


def _pickled(value: object) -> bytes:
    stream = io.BytesIO()
    _Pickler(stream).dump(value)
    return stream.getvalue()


# ---- what a result on disk was made from ---------------------------------------------------------


@functools.cache
def ground() -> bytes | None:
    """Return a digest of what is constant in a process: sources, versions, machine."""
    # Imported here, since the command line opens the cache before it needs any of them.
    import equinox
    import jax
    import jaxlib
    import numpy as np
    import scipy

    code = loaded_sources()
    if code is None or jax.local_device_count() > 1 or jax.default_backend() != "cpu":
        return None
    below = (np, scipy, jax, jaxlib, equinox)
    parts = [*(module.__version__ for module in below), sys.version, processor()]
    # JAX reads environment variables once, at import.
    parts += sorted(f"{key}={value}" for key, value in os.environ.items() if _sets(key.lower()))
    return hashlib.sha256(code + "\0".join(parts).encode()).digest()


def _sets(name: str) -> bool:
    return name.startswith(_SETTINGS) and not any(word in name for word in _IDLE)


@functools.cache
def _switches() -> tuple[str, ...]:
    import jax

    return tuple(filter(_sets, sorted(jax.config.values)))


@functools.cache
def loaded_sources() -> bytes | None:
    """Return the digest of the sources at the first call."""
    return sources()


def sources() -> bytes | None:
    """Return a digest of the source files; None if the loaded code may differ from them."""
    # Found and not imported, since the command line opens the cache before it needs JAX.
    ranges = importlib.util.find_spec("echelon_ranges")
    homes, hasher = [Path(__file__).parents[1]], hashlib.sha256()
    homes += [Path(place) for place in (ranges and ranges.submodule_search_locations) or ()]
    try:
        files = [
            (file.relative_to(home.parent), file.stat(), file.read_bytes())
            for home in homes
            for file in sorted(home.rglob("*.py"))
        ]
    except OSError:
        return None
    # A file copied with an old date counts by its change time.
    late = any(max(status.st_mtime, status.st_ctime) >= BEGAN for _, status, _ in files)
    if late or Path(*Path(__file__).parts[-3:]) not in (file for file, *_ in files):
        return None
    for file, _, content in files:
        hasher.update(f"{file}\0{len(content)}\0".encode() + content)
    return hasher.digest()


def processor() -> str:
    """Return the processor features that compiled code depends on."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().partition("\n\n")[0].splitlines()
        named = ("model name", "flags", "CPU part", "Features")
        return "\n".join(line for line in lines if line.startswith(named))
    return " ".join((platform.machine(), platform.processor(), platform.platform()))
