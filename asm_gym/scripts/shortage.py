"""Say in one line that memory is short. Libraries say it by many exceptions; with very little they abort or hang."""

from __future__ import annotations

import resource

LEAST_GIB = 1.0  # of address space: with less, LLVM aborts and OpenBLAS waits for ever [GiB]
ENOUGH_GIB = 6.0  # of address space: MuJoCo's environments run [GiB]
GIB = 2**30

# How libraries say that they got no memory, in small letters.
MESSAGES = (
    "could not allocate",  # MuJoCo
    "unable to allocate",  # NumPy
    "cannot allocate memory",  # the operating system
    "memory allocation",  # OpenBLAS, MuJoCo's reader of pictures
    "out of memory",
    "failed to map segment",  # the dynamic linker
    "can't start new thread",  # no memory for its stack
    "caught an unknown exception",  # numba, of std::bad_alloc in LLVM
    "std::bad_alloc",
)


def check_address_space() -> None:
    """Raise MemoryError if this process may use too little address space to fail in an orderly way."""
    allowed = allowed_gib()
    if allowed is not None and allowed < LEAST_GIB:
        raise MemoryError("the libraries do not fit")


def shortage_of(error: BaseException) -> str:
    """Return a line that says which memory is short; empty where an error means something else."""
    words = " ".join(str(error).split())
    says_so = any(message in words.lower() for message in MESSAGES)
    if not says_so and not isinstance(error, MemoryError):
        return ""
    line = "out of memory"
    if words:
        line += f": {words}"
    allowed = allowed_gib()
    if allowed is None:
        return f"{line}; free some, or use fewer --workers"
    return (
        f"{line}; {allowed:.2g} GiB of address space are allowed, and environments of robots run "
        f"with {ENOUGH_GIB:g}: raise ulimit -v"
    )


def allowed_gib() -> float | None:
    """Return how much address space this process may use [GiB]; None for any."""
    allowed, _ = resource.getrlimit(resource.RLIMIT_AS)
    if allowed == resource.RLIM_INFINITY:
        return None
    return allowed / GIB
