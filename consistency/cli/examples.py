"""Examples at the end of each command's help."""

from __future__ import annotations

import typer

EXAMPLES = {
    "simulate": ("simulate herath2007-stereo --runs 10 --out log",),
    "frontend": ("frontend IMAGES --out drive", "frontend IMAGES --calibration stereo.yml --rate 20 --out drive"),
    "run": (
        "run herath2007-stereo --filter ekf-uvd --filter ukf-uvd --out results",
        "run world.toml --filter ekf-uvd --until-decided --out results",
        "run --log log --filter ekf-uvd --out results",
        "run --log log --screen 2,2,1 --filter ekf-uvd --out results",
    ),
    "analyse": (
        "analyse results --fail-on inconsistent",
        "analyse mine.npz --report look",
        "analyse est.txt --truth truth.txt --covariance P.txt --error so3",
        "analyse est --truth truth --align posyaw",
        "analyse results --skip 2s",
    ),
    "plan": ("plan herath2007-stereo --filter ekf-uvd --detect 1.2", "plan --like results"),
    "compare": (
        "compare results --filter ukf-uvd --filter ekf-uvd",
        "compare new.csv old.csv --truth truth.csv --fail-on worse",
    ),
    "baseline": ("baseline results --out baseline.json",),
    "report": ("report results", "report est.txt --truth truth.txt --covariance P.txt"),
    "reproduce": ("reproduce --out findings", "reproduce --only fig3-chain --runs 20 --out findings"),
    "monitor": ("monitor innovations.csv --innovations optimal --plot alarm.png", "monitor flight.ulg"),
    "challenge": ("challenge ukf-uvd --minutes 5 --out worst.toml",),
    "characterise": (
        "characterise log --out sensor.toml",
        "characterise IMAGES --board 9x6 --square 0.024 --out s.toml",
    ),
    "compile": (
        "compile ekf-uvd ukf-uvd --scenario herath2007-stereo",
        "compile ekf-uvd --into /opt/kernels --cpu x86-64-v3",
    ),
    "sweep": ("sweep regime --out regime", "sweep grid.toml --share 1/4 --out cells"),
    "recommend": ("recommend herath2007-stereo --range 6",),
    "tune": ("tune herath2007-optimistic --filter oc-ekf-xyz", "tune --log log --filter ekf-uvd"),
}


def show_examples(app: typer.Typer) -> None:
    """Below the options of each command; the mark keeps the lines as they are."""
    for command in app.registered_commands:
        assert command.callback is not None
        lines = EXAMPLES.get(command.name or command.callback.__name__)
        if lines:
            command.epilog = "\b\nExamples:\n" + "\n".join(f"  consistency {line}" for line in lines)
