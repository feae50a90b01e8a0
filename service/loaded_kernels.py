"""What numba keeps of kernels from its cache only to build others on them is packed away.

With each kernel that it loads numba keeps the intermediate form, a tree of objects, for kernels that may be compiled
later and call this one; and a print of its types. 140 kernels take 32 MB so. A daemon whose cache is warm compiles
nothing; should it have to, the form is unpacked for that moment.
"""

from __future__ import annotations

import functools
import zlib
from typing import Any

_PACKING = 1  # zlib's level


class _Packed:
    """Stands for a library's method that hands its intermediate form to the linker."""

    def __init__(self, bitcode: bytes) -> None:
        self._packed = zlib.compress(bitcode, _PACKING)

    def __call__(self) -> Any:
        from llvmlite.binding import parse_bitcode

        return parse_bitcode(zlib.decompress(self._packed))


def keep_loaded_kernels_packed() -> None:
    """From now on, in this process. Before the first kernel is loaded; a numba that does it otherwise is left alone."""
    from numba.core import caching

    loads = getattr(caching, "CompileResultCacheImpl", None)
    original = getattr(loads, "rebuild", None)
    if loads is None or original is None or hasattr(original, "__wrapped__"):
        return

    @functools.wraps(original)
    def rebuild(self: Any, target_context: Any, payload: Any) -> Any:
        compiled = original(self, target_context, payload)
        return _without_form(compiled, _bitcode_or_none(payload))

    loads.rebuild = rebuild


def _bitcode_or_none(payload: Any) -> bytes | None:
    """The intermediate form in what the cache holds of a kernel."""
    match payload:
        case ((_, "object", (_, bytes() as bitcode)), *_):
            return bitcode
    return None


def _without_form(compiled: Any, bitcode: bytes | None) -> Any:
    library = getattr(compiled, "library", None)
    has_form = getattr(library, "_shared_module", None) is not None and hasattr(library, "_get_module_for_linking")
    if bitcode is None or not has_form:
        return compiled
    setattr(library, "_get_module_for_linking", _Packed(bitcode))  # noqa: B010 - of others, whose types say nothing
    setattr(library, "_shared_module", None)  # noqa: B010
    return compiled._replace(type_annotation="")
