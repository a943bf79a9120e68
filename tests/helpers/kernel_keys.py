"""Keys of the kernels of built-in filters; as a script, with every number in a folder of the filters doubled.

python kernel_keys.py FOLDER
"""

import ast
import json
import sys
from importlib.machinery import SourceFileLoader


class Doubled(ast.NodeTransformer):
    """Every number twice as large."""

    def visit_Constant(self, node):
        is_number = type(node.value) in (int, float)
        return ast.copy_location(ast.Constant(2 * node.value), node) if is_number else node  # type: ignore[operator]


def edit(folder):
    """Load the modules in a folder of the package's filters with other numbers, and leave no bytecode of them."""
    get_code, inside = SourceFileLoader.get_code, f"consistency.bench.filters.{folder}."
    assert not [name for name in sys.modules if name.startswith(inside)]

    def edited(self, name):
        if not name.startswith(inside):
            return get_code(self, name)
        tree = ast.fix_missing_locations(Doubled().visit(ast.parse(self.get_data(self.path))))
        return compile(tree, self.path, "exec")

    SourceFileLoader.get_code = edited  # type: ignore[method-assign, assignment]


def keys():
    """Key of the kernel of each compiled filter, on a trial of a scenario whose sensor it takes."""
    import consistency as cs
    from consistency.bench.filters import usable_names
    from consistency.bench.filters.compiled import Compiled
    from consistency.bench.filters.kernel.loop import trial_kernel

    scenarios = [
        cs.load_scenario(name) for name in ("herath2007-stereo", "linear-gaussian", "esde-xy", "range-bearing")
    ]
    trials = {each.belief.sensor.model: (cs.simulate(each), each.belief) for each in scenarios}
    found = {}
    for filter_ in map(cs.get_filter, usable_names()):
        if isinstance(filter_, Compiled):
            trial, belief = next(trials[model] for model in filter_.sensors if model in trials)
            found[filter_.name] = trial_kernel.outlook(*filter_._arguments(trial, belief)).key
    return found


if __name__ == "__main__":
    edit(sys.argv[1])
    print(json.dumps(keys()))
