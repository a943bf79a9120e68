"""Average NEES of the pose over steps, as Herath et al. (2007) fig. 11."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from consistency.bench.pages.report_input import Study, Track
from consistency.referee.diagnostics import Verdict
from consistency.referee.diagnostics.verdict.answers import STEP
from consistency.referee.document.colours import EXPECTED, LIMIT, SHADE
from consistency.referee.document.drawing import Axis, Band, Figure, Key, Line, Mark, Panel, Rule, Sheet, xy
from consistency.referee.document.wording import listed
from consistency.referee.pages.judged import wide
from consistency.referee.pages.section import STUDY, Section
from consistency.referee.types import Array

DIMENSION = "3"  # of a pose: what is expected where no filter has a band


@dataclass(frozen=True)
class Curve:
    """One filter; T steps."""

    track: Track
    values: Array  # (T,)
    band: Array  # (T, 2), where the ANEES of a consistent filter lies in one step
    simultaneous: Array | None  # (T, 2), where it lies in all steps at once
    own_band: bool  # failed runs, or an earlier decision, have made the bands differ from those of the study

    @property
    def expected(self) -> float:
        """Mean NEES of a right filter."""
        scale = self.track.verdict.scale
        return float("nan") if scale is None else float(scale.dof)


@dataclass(frozen=True)
class Anees:
    """All filters whose errors are known."""

    study: Study
    curves: tuple[Curve, ...]

    @property
    def log(self) -> bool:
        return wide([v for c in self.curves for v in (c.values, c.simultaneous) if v is not None])

    @property
    def common(self) -> Curve | None:
        return next((curve for curve in self.curves if not curve.own_band), None)


def read(study: Study) -> Anees | None:
    """Curves and bands of the verdicts; None where the truth is not known."""
    if not study.has_truth:
        return None
    shared = common({track.name: track.verdict for track in study.tracks})
    return Anees(study, tuple(_curve(t, shared) for t in study.tracks if t.verdict.scale is not None))


def _curve(track: Track, shared: Verdict | None) -> Curve:
    scale, location = track.verdict.scale, track.verdict.location
    assert scale is not None
    simultaneous = None if location is None else location.simultaneous
    return Curve(track, scale.anees, scale.band, simultaneous, _fewer(track.verdict, shared))


def common(verdicts: dict[str, Verdict]) -> Verdict | None:
    """The verdict of most runs whose band is drawn for all filters: those of the others are wider."""
    judged = [(v, v.scale) for v in verdicts.values() if v.scale is not None and v.scale.judged_steps]
    best = min(judged, key=lambda p: (-p[0].runs, len(p[0].failures), -int(p[1].alive.sum())), default=None)
    return None if best is None else best[0]


def _fewer(verdict: Verdict, shared: Verdict | None) -> bool:
    if verdict.scale is None or shared is None or shared.scale is None:
        return False
    same = np.array_equal(verdict.scale.band, shared.scale.band, equal_nan=True)
    return not same and (bool(verdict.failures) or verdict.runs < shared.runs)


def figures(anees: Anees) -> tuple[Figure, ...]:
    study = anees.study
    name = f"{study.statistic} of the pose"
    marks = [*_bands(anees), *(_line(curve, study) for curve in anees.curves)]
    alt = f"{study.statistic} of {study.name} over time"
    panel = Panel(study.clock.whole, Axis(name, log=anees.log), tuple(marks), alt, height=360)
    keys = (
        Key("95 % band of one step", SHADE, "band"), Key("band of all steps at once", LIMIT), Key("expected", EXPECTED),
        *study.keys(),
    )  # fmt: skip
    return (Figure(name, caption(anees), (panel,), (Sheet((panel,), 2.2, keys=keys),), keys),)


def _bands(anees: Anees) -> list[Mark]:
    """The bands of the study shaded and dashed, those that differ as thin lines in the filter's colour."""
    marks: list[Mark] = []
    steps, shared = anees.study.clock.values, anees.common
    if shared is not None:
        marks.append(Band(steps, *xy(shared.band), SHADE))
        if shared.simultaneous is not None:
            marks.append(Band(steps, *xy(shared.simultaneous), LIMIT, outline=True))
        marks.append(Rule("y", shared.expected, EXPECTED))
    for curve in anees.curves:
        if curve.own_band:
            marks += _own_bands(curve, steps)
    return marks


def _own_bands(curve: Curve, steps: Array) -> list[Mark]:
    marks: list[Mark] = []
    look, owner = curve.track.look, curve.track.owner
    if curve.simultaneous is not None:
        dashed = replace(look, dash=LIMIT.dash, width=0.9)
        marks.append(Band(steps, *xy(curve.simultaneous), dashed, owner, outline=True))
    dotted = replace(look, dash=(1.0, 2.0), width=0.7)
    return [*marks, Band(steps, *xy(curve.band), dotted, owner, outline=True)]


def _line(curve: Curve, study: Study) -> Line:
    tips = [
        *study.clock.tips,
        (study.statistic, "@y{0.000}"),
        ("95 % band, one step", "@low{0.00} to @high{0.00}"),
    ]
    columns = {"step": study.steps, "low": curve.band[:, 0], "high": curve.band[:, 1]}
    if curve.simultaneous is not None:
        tips.append(("band of all steps", "@least{0.00} to @most{0.00}"))
        columns |= {"least": curve.simultaneous[:, 0], "most": curve.simultaneous[:, 1]}
    return Line(study.clock.values, curve.values, curve.track.look, curve.track.owner, tuple(tips), columns)


def caption(anees: Anees) -> str:
    study, shared = anees.study, anees.common
    runs = shared.track.verdict.runs if shared else study.runs
    what = f"NEES of the single run {study.shown_run}" if study.single else f"Average NEES over {runs} runs"
    expected = f"{shared.expected:g}" if shared else DIMENSION
    own = [curve.track.name for curve in anees.curves if curve.own_band]
    extra = (
        f" Fewer runs carry the curve of {listed(own)}; its wider bands are thin lines in its colour." if own else ""
    )
    return (
        f"{what}; {expected} is expected (line). Shaded: the 95 % band of a single step (eq. 17), which is not judged."
        f"{_simultaneous(anees)} Above is overconfident, below conservative.{extra}{_own(anees)}"
    )


def _own(anees: Anees) -> str:
    """Whose NEES is that of another error than the additive one."""
    own = anees.study.own_errors
    return f" In the filter's own error: {listed(own)}." if own else ""


def _simultaneous(anees: Anees) -> str:
    """What the dashed band is, where a filter was asked about single steps."""
    if anees.common is None:
        return ""
    track = anees.common.track
    shares = [a.share for a in track.verdict.answers if a.question == STEP]
    if not shares:
        return ""
    others = f", drawn for {track.name}: dependence between steps moves it a little"
    return (
        " Dashed: the band of all steps at once, which a consistent filter leaves anywhere in the run with "
        f"probability at most {100 * shares[0] * track.verdict.settings.false_alarm:.2g} %, its share of the verdict's "
        f"false-alarm rate{others if len(anees.study.tracks) > 1 else ''}."
    )


SECTION = Section(STUDY, read, figures)
