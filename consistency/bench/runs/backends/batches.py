"""Runs in batches, for an engine that knows nothing of runs: how many at a time, and what becomes of lost ones."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from consistency.bench.filters.recorder import RunRecord
from consistency.bench.filters.stepping import error_of, name_of, rejects
from consistency.bench.runs.backends.remote import Part, require_same_versions
from consistency.bench.runs.trial_work import Outcomes, TrialWork
from consistency.bench.store.trial_rows import RunOutcome, outcome_of
from consistency.referee.errors import InputError
from consistency.referee.system.progress import say
from consistency.referee.system.provenance import in_words


@dataclass(eq=False)
class Batch:
    """Runs that are sent together, of which ``left`` have not come back.

    ``losses`` counts how often the batch was lost without a run of it having come back since; a ``suspect`` is one
    run of a batch that was lost too often.
    """

    runs: tuple[int, ...]
    losses: int = 0
    is_suspect: bool = False
    left: list[int] = field(init=False)

    def __post_init__(self) -> None:
        self.left = list(self.runs)


Event = tuple[Batch, Part | str | None]  # some runs of a batch; why who did it is dead; its end


class Engine(Protocol):
    """Where batches are done."""

    @property
    def room(self) -> int:
        """Batches that it should have at a time, waiting ones included."""

    def submit(self, batches: Sequence[Batch], /) -> None: ...

    def events(self) -> Sequence[Event]:
        """What has happened to batches since, after some waiting if nothing has."""


class Batches:
    """Runs that are to be done, in batches.

    Parameters
    ----------
    seconds : of work in a batch; None for equal shares
    retries : how often a lost batch is sent again as it was
    shares : whether the death of one batch takes others with it. Then a suspect is sent when nothing else is, so that
        no run is blamed for the death of another, and a second time before it is
    """

    def __init__(
        self, runs: Sequence[int], seconds: float | None = None, retries: int = 0, shares: bool = True
    ) -> None:
        self._todo, self._again, self._suspects = deque(runs), deque[Batch](), deque[Batch]()
        self._seconds, self._retries, self._shares = seconds, retries, shares
        self._in_flight: set[Batch] = set()
        self._per_run: float | None = None  # s

    @property
    def are_done(self) -> bool:
        return not (self._todo or self._again or self._suspects or self._in_flight)

    def take(self, room: int) -> list[Batch]:
        """Batches to send now, so that ``room`` are with the engine."""
        taken = []
        while len(self._in_flight) < room and (batch := self._next(room)) is not None:
            self._in_flight.add(batch)
            taken.append(batch)
        return taken

    def _next(self, room: int) -> Batch | None:
        if self._again:
            return self._again.popleft()
        if self._todo:
            size = min(self._size(room), len(self._todo))
            return Batch(tuple(self._todo.popleft() for _ in range(size)))
        if self._suspects and not (self._shares and self._in_flight):
            return self._suspects.popleft()
        return None

    def _size(self, room: int) -> int:
        """Runs for a batch: one until it is known how long one takes; smaller batches at the end, for every worker."""
        if self._seconds is None:
            return -(-len(self._todo) // (room - len(self._in_flight)))
        if self._per_run is None:
            return 1
        share = -(-len(self._todo) // room)
        return max(1, min(int(self._seconds / max(self._per_run, 1e-9)), share))

    def came(self, batch: Batch, runs: Collection[int], seconds: float) -> list[int]:
        """Runs of a batch are here, which took so long; those of them that had not come before."""
        new = [run for run in runs if run in batch.left]
        batch.left = [run for run in batch.left if run not in runs]
        batch.losses = 0 if new else batch.losses
        if new:
            now = seconds / len(runs)
            self._per_run = now if self._per_run is None else (self._per_run + now) / 2
        return new

    def ended(self, batch: Batch) -> None:
        """A batch is over; what has not come is to be done by others."""
        self._in_flight.remove(batch)
        self._todo.extendleft(reversed(batch.left))

    def lost(self, batch: Batch) -> list[int]:
        """Who did a batch is dead; the runs that have failed by it, as they were tried often enough."""
        self._in_flight.remove(batch)
        left, losses = tuple(batch.left), batch.losses + 1
        if not left or (batch.is_suspect and (losses > 1 or not self._shares)):
            return list(left)
        if batch.is_suspect:  # those that had it may have been dying of another
            self._suspects.append(Batch(left, losses, is_suspect=True))
        elif losses <= self._retries:
            self._again.append(Batch(left, losses))
        else:
            self._suspects.extend(Batch((run,), is_suspect=True) for run in left)
        return []


def in_batches(engine: Engine, batches: Batches, work: TrialWork) -> Outcomes:
    """What each run leaves, in the order in which batches come back.

    Raises
    ------
    InputError
        A filter needs what a trial does not have; a worker has other versions than this process.
    """
    machines: list[dict[str, str]] = []
    while not batches.are_done:
        engine.submit(batches.take(engine.room))
        for batch, what in engine.events():
            match what:
                case None:
                    batches.ended(batch)
                case str(reason):
                    for run in batches.lost(batch):
                        yield failed(work, run, reason)
                case Part():
                    require_same_versions(what)
                    _say_new(what.machine, machines)
                    outcomes = what.outcomes()
                    new = batches.came(batch, [outcome.run for outcome in outcomes], what.seconds)
                    yield from (outcome for outcome in outcomes if outcome.run in new)
                    if what.refusal:
                        raise InputError(what.refusal)


def failed(work: TrialWork, run: int, reason: str) -> RunOutcome:
    """What a run leaves that could not be done: all filters have failed in step 1."""
    trial = work.trials(run)
    record = RunRecord.empty(trial.steps, len(trial.landmark))
    return outcome_of(
        trial,
        [record.estimates(name_of(f), trial.run, error_of(f), reason=reason, guarded=rejects(f)) for f in work.filters],
    )


def _say_new(machine: dict[str, str], machines: list[dict[str, str]]) -> None:
    """Say that the workers are not all alike, once for each that is not."""
    if machine in machines:
        return
    machines.append(machine)
    if len(machines) > 1:
        say(
            f"consistency: the workers differ, {in_words(machines)}: the last digits of the results may differ from "
            "those of one machine"
        )
