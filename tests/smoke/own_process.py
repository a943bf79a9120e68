"""The command line in a process of its own."""

import subprocess
import sys

import forks

COMPILING = 300.0  # s, of a command that may compile
IMPORTS = """
import consistency as cs
import consistency.commands, consistency.referee.show.as_html, consistency.referee.show.figures
import consistency.referee.show.pdf, consistency.referee.verdicts.compare_sources
import consistency.bench.runs.montecarlo, consistency.bench.sweeps.run_sweep

cs.get_filter("ekf-uvd")
cs.analyse(cs.run_trials(cs.load_scenario("linear-gaussian").variant("short", truth__steps=8), ["kf"], 20, jobs=1))
"""
CODE = "from consistency.__main__ import main; sys.exit(main())"
BEGUN = []  # ended after the test, whatever became of it


def begun(*arguments, cwd, before="", out=None, err=None):
    """The command line in a fork, which does ``before`` first."""
    BEGUN.append(forks.begun(IMPORTS, f"{before}\n{CODE}", "consistency", *arguments, cwd=cwd, out=out, err=err))
    return BEGUN[-1]


def consistency(*arguments, cwd, status=0):
    """Run the command line; the exit status must be ``status``.

    In a process that begins with nothing where it compiles, or chooses a processor before Numba is loaded.
    """
    if "compile" in arguments and (status == 0 or "--cpu" in arguments):
        command = [sys.executable, "-m", "consistency", *arguments]
        done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=COMPILING)
    else:
        program = begun(*arguments, cwd=cwd)
        said = program.communicate(COMPILING)
        done = subprocess.CompletedProcess(program.args, program.wait(), *said)
    assert done.returncode == status, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return done


def size_of(path):
    """Bytes of a file that may go at any moment; 0 if it is not there."""
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0
