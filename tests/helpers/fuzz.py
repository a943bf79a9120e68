"""Damaged files through every reader: ``python tests/helpers/fuzz.py CASES [SEED]``; CONTRIBUTING.md says more.

Each case damages one file of a valid folder and has it read as the command line reads it. Allowed are exit status 2
with one sentence on stderr, and status 0; a damage that must be refused may not end in status 0, and where a file has
checksums status 0 means that nothing else was read. Not allowed are any other exception, a warning, more than a
gigabyte, and more than 20 s. The process that reads is a child, so that a crash is a finding, too.
"""

import contextlib
import io
import json
import resource
import signal
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from pathlib import Path

ROOM = 2**30  # bytes above what the process has taken before it reads
PATIENCE = 20  # s for a case
OFTEN = 3  # times as many cases of a damage that knows the format
CHECKED = (".parquet", ".npz", ".png")  # files with checksums: what is still read of them must be what they held
UNCHECKED = {"table/est.parquet", "table/truth.parquet"}  # as other programs write them, pages without a checksum
SAME = ("flip", "truncate", "splice", "garbage", "nulls", "notes", "packed", "locked")


class Slow(BaseException):
    """A case took too long; no reader may take it for an error of its own."""


def outcome(read, folder):
    """Exit status, stdout, stderr, and what is wrong with them whatever the file held."""
    from consistency.referee.errors import InputError
    from consistency.referee.parsing import one_line

    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        status, wrong = 0, ""
        signal.alarm(PATIENCE)
        try:
            read(folder)
        except SystemExit as stop:
            status = int(stop.code or 0)
        except InputError as error:
            status = 2
            print(f"consistency: {one_line(error, 4000)}", file=sys.stderr)
        except Slow:
            wrong = f"more than {PATIENCE} s"
        except BaseException:
            wrong = traceback.format_exc(limit=-4)
        finally:
            signal.alarm(0)
    text = err.getvalue()
    last = text.splitlines()[-1] if text else ""
    if wrong:
        return status, out.getvalue(), text, wrong
    if status not in (0, 2) or any(word in text for word in ("Traceback", "Warning", "unforeseen")):
        wrong = f"status {status}: {text[-300:]}"
    elif status == 2 and not (last.startswith("consistency: ") and len(last) < 4200 and last.isprintable()):
        wrong = f"no sentence: {text[-300:]!r}"
    elif "memory" in last and "damage" not in last:
        wrong = f"takes too much memory: {last}"
    return status, out.getvalue(), text, wrong


def in_pages(before, after):
    """Whether bytes in pages of a Parquet file differ: without checksums it is a file of other numbers."""
    import numpy as np
    import pyarrow.parquet as pq

    if len(before) != len(after):
        return False
    groups, pages = pq.read_metadata(io.BytesIO(before)), np.zeros(len(before), bool)
    for group in map(groups.row_group, range(groups.num_row_groups)):
        for chunk in map(group.column, range(group.num_columns)):
            begin = chunk.dictionary_page_offset or chunk.data_page_offset
            pages[begin : begin + chunk.total_compressed_size] = True
    return bool(pages[np.frombuffer(before, np.uint8) != np.frombuffer(after, np.uint8)].any())


def cases(count, seed):
    """(target, file, damage, must be refused) of each case, all kinds in turn."""
    import numpy as np
    from hostile_work import TARGETS
    from mutations import ANY

    kinds = [
        (k, file, name, name in target.refused)
        for k, target in enumerate(TARGETS)
        for file in target.files
        for name in {**target.kinds, **target.refused}
        for _ in range(1 if name in ANY or target.seldom else OFTEN)
    ]
    order = np.random.default_rng(seed).permutation(len(kinds))
    return [kinds[order[i % len(kinds)]] for i in range(count)]


def child(count, seed, begin):
    """Do the cases from ``begin`` on; a line of JSON before each, and one after it."""
    import numpy as np
    import pyarrow as pa
    from hostile_work import TARGETS, write_all
    from mutations import copied

    def late(*_):
        raise Slow

    pa.set_cpu_count(1)
    signal.signal(signal.SIGALRM, late)
    said, sys.stdout = sys.stdout, io.StringIO()
    with tempfile.TemporaryDirectory() as place:
        valid, work = Path(place) / "valid", Path(place) / "work"
        write_all(valid)
        right = []
        for target in TARGETS:
            status, out, err, wrong = outcome(target.read, copied(valid / target.name, work))
            right.append(out)
            assert status == 0, (target, err, wrong)
            assert not wrong, (target, wrong)
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + ROOM, resource.RLIM_INFINITY))
        for number, (k, file, name, refused) in list(enumerate(cases(count, seed)))[begin:]:
            target = TARGETS[k]
            about = {"case": number, "target": target.name, "file": file, "damage": name}
            print(json.dumps(about), file=said, flush=True)
            folder = copied(valid / target.name, work)
            before = (folder / file).read_bytes()
            {**target.kinds, **target.refused}[name](folder / file, np.random.default_rng([seed, number]))
            after = (folder / file).read_bytes() if (folder / file).is_file() else b""
            status, out, err, wrong = outcome(target.read, folder)
            checked = name in SAME and file.endswith(CHECKED)
            if checked and f"{target.name}/{file}" in UNCHECKED:
                checked = not in_pages(before, after)
            if status == 0 and checked and out != right[k] and not wrong:
                wrong = f"reads something else: {out[:300]}"
            same = after == before
            if refused and status == 0 and not same and not wrong:
                wrong = "accepted"
            print(json.dumps(about | {"status": status, "wrong": wrong, "err": err[-400:]}), file=said, flush=True)


def fuzz(count, seed):
    """Number of cases by exit status, and the cases that are wrong."""
    statuses = Counter()
    wrong = []
    begin = 0
    while begin < count:
        command = [sys.executable, __file__, "child", str(count), str(seed), str(begin)]
        done = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parent)
        lines = [json.loads(line) for line in done.stdout.splitlines()]
        for line in lines:
            if "status" in line:
                statuses[line["status"]] += 1
                wrong += [line] if line["wrong"] else []
        if done.returncode == 0:
            return statuses, wrong
        if not lines:
            raise RuntimeError(done.stderr)
        wrong.append(lines[-1] | {"wrong": f"the process ended with {done.returncode}: {done.stderr[-500:]}"})
        begin = lines[-1]["case"] + 1
    return statuses, wrong


if __name__ == "__main__":
    if sys.argv[1] == "child":
        child(*map(int, sys.argv[2:]))
    else:
        found, bad = fuzz(*map(int, sys.argv[1:3]), *([0] if len(sys.argv) < 3 else []))
        for case in bad:
            print(json.dumps(case, indent=1).replace("\\n", "\n    "))
        print(f"{found.total()} cases: {found[2]} refused, {found[0]} read; {len(bad)} wrong")
        sys.exit(bool(bad))
