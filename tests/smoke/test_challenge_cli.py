"""``consistency challenge`` as a newcomer types it, in a process of its own, from an empty folder."""

import json

from own_process import consistency

FAR = ("--within", "steps=50:100", "--within", "range=6:9", "--trials", "100", "--jobs", "1")


def test_a_world_is_found_and_can_be_run(tmp_path):
    done = consistency(
        "challenge", "ekf-uvd", *FAR, "--out", "far.toml", "--json", "--fail-on", "found", cwd=tmp_path, status=1
    )
    data = json.loads(done.stdout)
    assert data["found"]
    assert data["file"] == "far.toml"
    assert data["runs"] == 61
    refused = consistency("challenge", "ekf-uvd", *FAR, "--out", "far.toml", cwd=tmp_path, status=2)
    assert "--out far.toml: exists already; name another file or add --overwrite" in refused.stderr
    options = ("--filter", "ekf-uvd", "--runs", "61", "--seed", str(data["seeds"]["confirmation"]), "--out", "results")
    again = consistency("run", "far.toml", *options, cwd=tmp_path)
    assert data["status"] in again.stdout
    assert f"{data['anees']:.2f}" in again.stdout
