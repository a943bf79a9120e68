import numpy as np

from consistency.bench.pages.sections.report_input import Study, Track
from consistency.referee.show.blocks import Figure
from consistency.referee.show.figures import add_legend, canvas, curve
from consistency.referee.types import Array


def rmse(track: Track) -> Array:
    """Root mean square error of the position over all runs in each step, (T,), m; NaN without estimate."""
    error = track.record().in_world.errors.error  # (runs, T, 3)
    squared = (error[..., :2] ** 2).sum(axis=-1)
    count = np.isfinite(squared).sum(axis=0)
    mean = np.nansum(squared, axis=0) / np.maximum(count, 1)
    return np.where(count > 0, np.sqrt(mean), np.nan)


def position_errors(study: Study) -> tuple[Figure, ...]:
    """A line for each filter; nothing where the truth is not known."""
    if not study.has_truth:
        return ()

    def draw():
        figure, (axes,) = canvas(2.0)
        for track in study.tracks:
            curve(axes, study.clock.values, rmse(track), track.look, track.name, track.tag)
        axes.set_ylabel("RMSE (m)")
        study.clock.span(axes)
        return add_legend(figure)

    caption = f"Root mean square error of the position over {study.runs} runs, step by step."
    return (Figure("Error of the position", caption, (draw,)),)
