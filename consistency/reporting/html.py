"""The report model as one HTML file that needs nothing else."""

from __future__ import annotations

from typing import Any

from bokeh.embed import components
from bokeh.resources import Resources
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from consistency.reporting import captions, diagnosis, plots, wording
from consistency.reporting.charts import MARKERS, distribution_charts, study_charts
from consistency.reporting.diagnosis_charts import diagnosis_charts
from consistency.reporting.model import Report
from consistency.reporting.stereo_charts import front_end_charts
from consistency.reporting.thin import LIMIT

MAXIMUM = 6_000_000  # bytes of the whole file
SCRIPT = 1_400_000  # bytes of Bokeh itself, style and words
CHART = 16_000  # bytes of a chart before its data
POINT = 5.4  # bytes of one number in base64
LEAST = 120  # points a line below which a curve is no curve
FRONT_END = 120_000  # bytes of the charts of the stereo front-end
NUMBERS = 26  # columns of all charts of one filter


def render_html(report: Report) -> str:
    """The whole page: style, script, data and words in one string."""
    limit = points_a_line(report)
    groups: list[dict[str, Any]] = []
    for index, study in enumerate(report.studies):
        charts = study_charts(study, index, limit) | diagnosis_charts(study, index, limit)
        groups.append({f"s{index}-{name}": chart for name, chart in charts.items()})
    for index, distribution in enumerate(report.distributions):
        pair = distribution_charts(distribution)
        groups.append({f"d{index}-cloud": pair[0], f"d{index}-histogram": pair[1]})
    if report.front_end:
        groups.append({f"f-{name}": chart for name, chart in front_end_charts(report.front_end).items()})
    # one document a study: Bokeh walks through a whole document for every chart added to it
    embedded = [components(group) for group in groups]
    environment = Environment(
        loader=PackageLoader("consistency.reporting"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    return environment.get_template("report.html.j2").render(
        report=report,
        wording=wording,
        captions=captions,
        diagnosis=diagnosis,
        style=plots.style,
        plots=plots,
        shapes=MARKERS,
        thinned=limit if any(len(study.steps) > limit for study in report.studies) else None,
        bokeh=Markup(Resources(mode="inline", components=["bokeh"]).render()) if groups else "",
        chart_scripts=[Markup(script) for script, _ in embedded],
        chart={name: Markup(div) for _, divs in embedded for name, div in divs.items()},
    )


def points_a_line(report: Report) -> int:
    """Points that a line may have so that the file stays below its greatest size."""
    tracks = sum(len(study.tracks) for study in report.studies)
    charts = 11 * len(report.studies) + 2 * len(report.distributions)
    room = MAXIMUM - SCRIPT - CHART * charts - 30_000 * len(report.distributions)
    room -= FRONT_END if report.front_end else 0
    return int(min(LIMIT, max(LEAST, room / (POINT * NUMBERS * max(tracks, 1)))))
