"""The processor that kernels are compiled for, to be chosen before Numba is loaded; standard library only."""

from __future__ import annotations

import os
import subprocess
import sys

from consistency.referee.errors import InputError

_KNOWN = """
import sys
from llvmlite import binding
binding.initialize_native_target()
binding.Target.from_default_triple().create_target_machine(cpu=sys.argv[1])
"""


def aim_at(name: str) -> dict[str, str]:
    """Compile for the processors that LLVM calls ``name``, as x86-64-v3, and not for the features of this one.

    Returns
    -------
    The environment in which what is compiled so is found

    Raises
    ------
    InputError
        LLVM knows no such processor.
    RuntimeError
        Numba is loaded already, for this machine's processor.
    """
    if "numba" in sys.modules:
        raise RuntimeError("the processor can be chosen before Numba is loaded only")
    told = subprocess.run([sys.executable, "-c", _KNOWN, name], capture_output=True, text=True, check=False)
    if told.returncode or "not a recognized" in told.stderr:
        raise InputError(f"--cpu {name}: LLVM knows no such processor; give one as x86-64-v3, znver3 or generic")
    environment = {"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": ""}
    os.environ.update(environment)
    return environment
