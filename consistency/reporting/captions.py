"""What stands under a figure or a table, the same in every format."""

from __future__ import annotations

import numpy as np

from consistency.diagnostics.questions import MAIN, STEP
from consistency.diagnostics.wording import plural, short
from consistency.reporting.calibration import Calibration
from consistency.reporting.diagnosis import DIRECTION, forests, lags
from consistency.reporting.model import Distribution, FirstOrder, Report, Scenes, Shares, Study, Track
from consistency.reporting.wording import FOUND, NOT_ASKED, NOT_FOUND, TOLERATED, equivalence_interval, listed


def no_truth(study: Study) -> str:
    """Why there are no error plots."""
    return (
        f"The truth of {study.name} is not known, so there are no pose errors and no NEES to show; the innovations "
        f"below are {'all that can be judged' if _judged(study) else 'reported and not judged'}."
    )


def verdict_caption(study: Study) -> str:
    """How large the study is, and how to read the table of verdicts."""
    text = f"{plural(study.runs, 'run')} of {plural(len(study.steps), 'step')}"
    if study.single and study.has_truth:
        text += "; with one run the ANEES is the NEES of that run"
    if study.until_decided:
        when = [f"{track.name} after {plural(track.verdict.runs, 'run')}" for track in study.tracks]
        text += f", until decided: a verdict is that of the look that decided, {listed(when)}"
    what = "of true to stated covariance" if study.has_truth else "of the NIS to its degrees of freedom"
    text += f". Shown inside {equivalence_interval(study)}: whether the ratio {what} is shown to lie there"
    if len(_judged(study)) < len(study.tracks):
        text += ". NIS in parentheses: reported and not judged, as no optimal gain is declared"
    return f"{text}."


def _judged(study: Study) -> list[str]:
    """Filters whose innovations are judged."""
    return [track.name for track in study.tracks if track.innovations_judged]


def scenario_caption(study: Study) -> str:
    """What the map shows."""
    parts = []
    if study.true_path is not None:
        parts.append("true path solid black with its start as a circle")
    if study.odometry is not None:
        parts.append("path by odometry alone dashed grey")
    if study.landmarks is not None:
        parts.append(f"{len(study.landmarks)} landmarks as stars")
    parts.append("estimates in the filters' colours")
    note = "" if study.odometry is not None else " The odometry path is left out: results of a log hold no controls."
    return f"{study.name} from above, run {study.shown_run}: {', '.join(parts)}.{note}"


def error_caption(study: Study) -> str:
    """What the error charts show."""
    return (
        f"Pose error (truth minus estimate) of run {study.shown_run}, the lowest run number, with the filter's own "
        "2-sigma bounds (dashed). An honest filter's error stays inside about 95 % of the time."
    )


def anees_caption(study: Study) -> str:
    """What the ANEES chart shows."""
    common = study.common_band
    runs = common.verdict.runs if common else study.runs
    what = f"NEES of the single run {study.shown_run}" if study.single else f"Average NEES over {runs} runs"
    n = f"{common.expected:g}" if common else "3"
    own = [track.name for track in study.tracks if track.own_band]
    extra = (
        f" Fewer runs carry the curve of {listed(own)}; its wider bands are thin lines in its colour." if own else ""
    )
    rate = _step_rate(common) if common else None
    others = f", drawn for {common.name}: dependence between steps moves it a little" if common else ""
    simultaneous = (
        " Dashed: the band of all steps at once, which a consistent filter leaves anywhere in the run with "
        f"probability at most {100 * rate:.2g} %, its share of the verdict's false-alarm rate"
        f"{others if len(study.tracks) > 1 else ''}."
        if rate is not None
        else ""
    )
    return (
        f"{what}; {n} is expected (line). Shaded: the 95 % band of a single step (eq. 17), which is not judged."
        f"{simultaneous} Above is overconfident, below conservative.{extra}"
    )


def _step_rate(track: Track) -> float | None:
    """Share of the false-alarm rate that the band over all steps has."""
    shares = [a.share for a in track.verdict.answers if a.question == STEP]
    return shares[0] * track.verdict.settings.false_alarm if shares else None


def innovation_caption(study: Study, panels: bool) -> str:
    """What the figures of innovations show; ``panels``: each filter has axes of its own."""
    over = "" if study.single else ", summed over the runs of its verdict"
    judged, every = _judged(study), len(study.tracks)
    text = (
        f"Normalized innovation squared over its degrees of freedom, one point a step{over}; not smoothed. "
        "1 (line) is expected of a right filter with an optimal gain."
    )
    if not judged:
        text += " No filter here declares one: its innovations are reported and not judged."
    elif len(judged) < every:
        declare = "declare" if len(judged) > 1 else "declares"
        text += f" Only {listed(judged)} {declare} one; the innovations of the others are reported and not judged."
    if panels and every > 1:
        text += " Axes differ between filters."
    if any(lags(track) for track in study.tracks):
        text += (" Right: " if panels else " Below: ") + "autocorrelation over steps"
        text += "; 95 % of the lags stay within the shaded bound if the innovations are white." if judged else "."
    return text


def distribution_caption(d: Distribution) -> str:
    """What one panel pair of fig. 12 shows, with its numbers."""
    linear, fitted = (float(np.sqrt(g.covariance[0, 0])) for g in (d.linear, d.fitted))
    beyond = f" {100 * d.outside:.1f} % of the samples lie beyond the axes." if d.outside >= 0.0005 else ""
    return (
        f"Baseline {d.baseline:g} m: {d.samples} samples of eq. 21 within the search range, for a point at x = 10 m, "
        f"y = 1 m ({len(d.points)} drawn). Standard deviation of x: {linear:.2f} m linearised, {fitted:.2f} m from the "
        f"samples' moments; mean {d.fitted.mean[0]:.2f} m.{beyond} Ellipses at 2 sigma."
    )


def shares_caption(found: Shares) -> str:
    """What the figure of shares by depth shows."""
    return (
        f"Share of {found.repetitions} repetitions whose N times mean NEES lies inside the 95 % region, by depth of "
        f"the triangulated point: {found.samples} noisy matches ({found.noise:g} px) a repetition, as Valencia & "
        "Andrade-Cetto (2018) fig. 2.2, which shows one repetition and no depth. A right covariance is at "
        f"{100 * found.expected:g} % (line). Shaded: shares that the binomial test accepts; it rejects a right "
        f"covariance at one depth with probability {100 * found.false_alarm:g} % at most."
    )


def scenes_caption(found: Scenes) -> str:
    """What the figure of scenes shows."""
    percent = f"{100 * found.confidence:g} %"
    return (
        f"N times the mean NEES of {found.samples} registrations (SVD) of {found.points} points over the {found.dof} "
        "that is expected, by the scene's greatest depth and the noise, in brackets the number of repetitions; as "
        f"Valencia & Andrade-Cetto (2018) fig. 2.3. Scenes begin at {found.near:g} m. Dot: mean of the repetitions; "
        "bar: their middle 95 %. "
        f"Shaded: the {percent} region of one repetition, which a right covariance leaves in "
        f"{100 * (1 - found.confidence):.2g} % of them. Above 1 is overconfident."
    )


def first_order_caption(found: FirstOrder) -> str:
    """What the map of cells shows."""
    lost = sum(int(np.isnan(cells.nees).sum()) for cells in found.estimators)
    note = f" Cells without a run that is left, not drawn: {lost}." if lost else ""
    return (
        "Where the first-order covariance breaks: mean NEES over its degrees of freedom against the standard deviation "
        "of the disparity over the disparity, log axes; a cell is one depth, baseline and pixel noise, with "
        f"{found.runs} runs ({found.points} points a registration, one a triangulation; {found.failed} runs failed "
        "in all). Accepted: the referee shows the errors to be consistent. It finds a right covariance at fault in a "
        f"cell with probability {100 * found.false_alarm:g} % at most, and a wrong one also for what the mean does not "
        f"show, such as bias or outliers. First order is asked to hold up to {100 * found.holds:g} % (dashed). Source: "
        f"this project, beyond Valencia & Andrade-Cetto (2018) sec. 2.3.3.{note}"
    )


def method(report: Report) -> str:
    """How a verdict comes about, in one paragraph."""
    tracks = [track for study in report.studies for track in study.tracks]
    rates = [track.verdict.settings.false_alarm for track in tracks]
    rate = f"{100 * rates[0]:.2g} %" if rates else "the false-alarm rate"
    text = (
        "A run is one observation: runs are independent, steps are not. The questions of a verdict together find a "
        f"fault in a right filter with probability {rate} at most, whatever they have to do with each other "
        "(Holm 1979, weighted)."
    )
    if tracks:
        text += _shown(tracks[0])
    if any(study.has_truth for study in report.studies):
        text += (
            " Half of the false-alarm rate belongs to the mean NEES of whole runs, for which the number of runs is "
            "planned; the other questions share the rest. Where a fault was absent before some step, the factor and "
            "the axes are those since that step."
        )
    if any(not study.has_truth for study in report.studies):
        text += (
            " Without truth the ratio is that of the NIS to its degrees of freedom, and only the innovations of a "
            "filter that declares an optimal gain are judged: those of any other need be neither white nor of the "
            "stated size."
        )
    if any(study.until_decided for study in report.studies):
        text += (
            " In a run until decided the scale is judged by an e-process, a bet against the filter that may be looked "
            "at at any time (Ville 1939); the other questions are asked after 12, 24, 48, ... runs, each time at a "
            "part of their share."
        )
    return text


def _shown(track: Track) -> str:
    """What consistent and undecided mean."""
    settings = track.verdict.settings
    upper = short(settings.factor)
    tests, inside = "two one-sided tests, each", f"between {short(1.0 / settings.factor)} and {upper}"
    if settings.one_sided:
        tests, inside = "a one-sided test", f"below {upper}"
    return (
        f" Consistent is shown: no question found a fault, and {tests} at {100 * (1.0 - settings.power):.2g} %, put "
        f"the ratio of true to stated covariance {inside}. With neither a fault nor that, a filter is undecided: its "
        "sentence has the ratio, its interval, and the number of runs that would probably decide."
    )


def question_caption(study: Study) -> str:
    """How to read the table of questions."""
    rate = 100 * study.tracks[0].verdict.settings.false_alarm if study.tracks else 5.0
    answers = [answer for track in study.tracks for answer in track.verdict.answers]
    tolerance = next((track.verdict.settings.tolerated for track in study.tracks), 1.0)
    within = f"{TOLERATED} one was found, but is shown to lie within the tolerance of ×{tolerance:g}, "
    text = (
        f"{FOUND} a fault was found, {within if any(a.tolerated for a in answers) else ''}{NOT_FOUND} none was found, "
        f"{NOT_ASKED} could not be asked. The number is the corrected p value: the false-alarm rate of the whole "
        f"verdict at which the fault would just be found ({rate:.2g} % or less is a fault)."
    )
    if study.until_decided:
        text += f" A verdict between two looks asks {MAIN} alone; the p values of the others are then 1."
    return text


def axis_caption(study: Study) -> str:
    """What the figure of axes shows."""
    parts = {part.name for part in forests(study)}
    text = "By axis of the pose. Covariance ratio: 1 is right (line), above is overconfident; log axis."
    if any(t.verdict.location is not None and t.verdict.location.since is not None for t in study.tracks):
        text += " Ratio and bias are those since the step that the verdict names."
    if any(track.verdict.axes is not None and track.verdict.axes.largest is not None for track in study.tracks):
        text += f" {DIRECTION.capitalize()}: chosen by one half of the runs and measured in the other."
    if "bias" in parts:
        text += " Bias: mean error in units of the stated sigma; 0 is right."
    if "coverage" in parts:
        text += " Coverage: share of runs within 2 sigma, in one step of each; 95.4 % is right."
    return (
        f"{text} Bars: 95 % intervals, of ratio and bias for all axes at once, of coverage exact for each axis; an "
        "arrow goes on beyond the drawn range. The questions decide, not the bars."
    )


def nees_caption(study: Study) -> str:
    """What the figure of the distribution shows."""
    return (
        "Distribution of the NEES: chi-square probability of the NEES in one step of each run, with nothing fitted. "
        "On the diagonal the covariance is right; a curve below it has too many large values (overconfident), above it "
        "too many small ones. Shaded: where the whole curve of a right filter lies with probability 95 %."
    )


def figure_caption() -> str:
    """What the columns of further figures are."""
    return (
        "Noncredibility index and inclination (Li & Zhao 2006): 0 dB is credible, 10 dB a covariance wrong by a factor "
        "of 10; inclination above 0 is overconfident. The ratio that would be found: with power 0.95 by these runs."
    )


def calibration_text(c: Calibration) -> str:
    """What the appendix on the referee measures."""
    return (
        "A gate is one verdict on one group of runs. Each line is a promise of the referee: which share of gates is "
        "counted at most, or at least, and the shares measured, from the world where the promise is kept best to the "
        "one where it is kept worst. Where the true over the stated covariance is 1 the filter is right, however its "
        "errors depend on each other. Of gates that end when they are decided, the mean number of runs in the worst "
        "world stands first. "
        f"Measured over {c.gates} gates ({c.steps} steps, {c.dof} degrees of freedom where not said otherwise, seed "
        f"{c.seed}), with exact binomial intervals. A promise is broken where the whole interval is on its wrong side."
    )


def calibration_worlds(c: Calibration) -> list[tuple[str, str]]:
    """The worlds of the appendix and what they are."""
    return [(name, about.replace("`", "")) for name, about in c.worlds.items()]
