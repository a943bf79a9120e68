"""Names of the columns of tables, of poses and of covariances in files."""

POSE = ["x", "y", "heading"]
COVARIANCE = {"P_xx": (0, 0), "P_xy": (0, 1), "P_xh": (0, 2), "P_yy": (1, 1), "P_yh": (1, 2), "P_hh": (2, 2)}
OWN_COVARIANCE = {f"own_{name}": place for name, place in COVARIANCE.items()}  # of a filter's own error
POINT_COVARIANCE = {"P_xx": (0, 0), "P_xy": (0, 1), "P_xz": (0, 2), "P_yy": (1, 1), "P_yz": (1, 2), "P_zz": (2, 2)}
COLUMNS: dict[str, dict[str, str]] = {
    "landmarks": {"landmark": "int64", "x": "float64", "y": "float64", "z": "float64"},
    "truth": {"run": "int64", "step": "int64", "t": "float64", "x": "float64", "y": "float64", "heading": "float64"},
    "controls": {"run": "int64", "step": "int64", "dt": "float64", "v": "float64", "omega": "float64"},
    "observations": {
        "run": "int64", "step": "int64", "landmark": "int64", "z0": "float64", "z1": "float64",
    },
    "estimates": {
        "filter": "str", "run": "int64", "step": "int64", "t": "float64", "x": "float64", "y": "float64",
        "heading": "float64", **dict.fromkeys(COVARIANCE, "float64"), "nees": "float64", "nis": "float64",
        "nis_dof": "int64",
    },
    "failures": {"filter": "str", "run": "int64", "step": "int64", "reason": "str"},
    "rejections": {
        "filter": "str", "run": "int64", "offered": "int64", "spurious": "int64", "rejected": "int64",
        "rejected_spurious": "int64",
    },
    "map": {
        "filter": "str", "run": "int64", "landmark": "int64", "x": "float64", "y": "float64", "z": "float64",
        **dict.fromkeys(POINT_COVARIANCE, "float64"), "nees": "float64",
    },
}  # fmt: skip
