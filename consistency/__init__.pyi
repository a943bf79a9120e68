"""Names of the package and the modules they come from; ``__init__.py`` loads each when it is first used."""

from .diagnostics import Alarm as Alarm
from .diagnostics import Monitor as Monitor
from .diagnostics import anees as anees
from .diagnostics import anees_interval as anees_interval
from .diagnostics import nees as nees
from .diagnostics.records import Verdict as Verdict
from .errors import InputError as InputError
from .filters import filter_names as filter_names
from .filters import get_filter as get_filter
from .filters.guard.guarded import guarded as guarded
from .runs.findings import Study as Study
from .runs.montecarlo import run_trials as run_trials
from .scenario import Scenario as Scenario
from .scenario import load_scenario as load_scenario
from .scenario import scenario_names as scenario_names
from .simulation import simulate as simulate
from .store.results import Results as Results
from .store.results import read_results as read_results
from .types import Control as Control
from .types import Finding as Finding
from .types import Gaussian as Gaussian
from .types import Info as Info
from .types import Observation as Observation
from .types import Trial as Trial
from .verdicts.judge import analyse as analyse
