"""Compiled functions as bytes and back, with as little of Numba and LLVM as running them takes.

Numba keeps, beside the machine code of a function, LLVM's view of it, from which functions that call it are compiled. It parses
that view and lists its symbols whenever machine code is loaded, which is most of the time that takes. Here the symbols are saved
as well, and the view is parsed when something that links to the function is compiled.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import llvmlite.binding as llvm
from numba.core import compiler
from numba.core.codegen import JITCodeLibrary
from numba.core.runtime import nrtdynmod
from numba.core.runtime.nrt import rtsys

Saved = tuple[str, bytes, bytes, tuple[str, ...]]
"""Name, machine code, LLVM's view, and symbols defined, of a library."""


class _LoadedLibrary(JITCodeLibrary):  # type: ignore[misc]
    def __init__(self, codegen: Any, saved: Saved) -> None:
        name, machine_code, self._view, symbols = saved
        super().__init__(codegen, name)  # type: ignore[no-untyped-call]
        self.enable_object_caching()  # type: ignore[no-untyped-call]
        self._set_compiled_object(machine_code)  # type: ignore[no-untyped-call]
        self._finalize_final_module()  # type: ignore[no-untyped-call]
        codegen._engine._defined_symbols.update(symbols)

    def _get_module_for_linking(self) -> Any:
        if self._shared_module is None:
            self._shared_module = llvm.parse_bitcode(self._view)
        return self._shared_module


def _saved(library: Any) -> Saved:
    name, _, (machine_code, view) = library.serialize_using_object_code()
    module = library._get_module_for_linking()
    values = (*module.functions, *module.global_variables)
    return name, machine_code, view, tuple(value.name for value in values if not value.is_declaration)


def reduce_function(compiled: Any) -> tuple[Any, ...]:
    """What `rebuild_function` makes a compiled function of, in another process; it can be pickled."""
    _, *facts = compiled._reduce()
    return _saved(compiled.library), *facts


def rebuild_function(target_context: Any, reduced: tuple[Any, ...]) -> Any:
    """The compiled function that was reduced; as Numba's `CompileResult._rebuild` but for the library."""
    saved, description, environment, signature, objectmode, lifted, annotation, initializers, environments = reduced
    for initialize in initializers:
        initialize()
    library = _LoadedLibrary(target_context.codegen(), saved)
    entry_point = target_context.get_executable(library, description, environment)
    for referenced in environments:
        library.codegen.set_env(referenced.env_name, referenced)
    return compiler.compile_result(  # type: ignore[no-untyped-call]
        target_context=target_context,
        typing_context=target_context.typing_context,
        library=library,
        environment=environment,
        entry_point=entry_point,
        fndesc=description,
        type_annotation=annotation,
        signature=signature,
        objectmode=objectmode,
        lifted=lifted,
        reload_init=initializers,
        referenced_envs=environments,
    )


def start_runtime(target_context: Any, load: Callable[[Any], Saved | None], save: Callable[[Any, Saved], None]) -> None:
    """Start what counts references and allocates in compiled functions; Numba compiles it in every process.

    Args:
        load: called with the target context, gives what `save` was once called with, or None.
    """
    if rtsys._init:
        return

    def library(target_context: Any) -> Any:
        saved = load(target_context)
        if saved is not None:
            return _LoadedLibrary(target_context.codegen(), saved)
        module, compiled = nrtdynmod.create_nrt_module(target_context)  # type: ignore[no-untyped-call]
        compiled.enable_object_caching()
        compiled.add_ir_module(module)
        compiled.finalize()
        save(target_context, _saved(compiled))
        return compiled

    compile_functions = nrtdynmod.compile_nrt_functions
    nrtdynmod.compile_nrt_functions = library
    try:
        rtsys.initialize(target_context)  # type: ignore[no-untyped-call]
    finally:
        nrtdynmod.compile_nrt_functions = compile_functions
