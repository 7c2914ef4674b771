"""python -m runtime.measure builds all forms, and measures each."""

from shutil import which

import pytest

from files import read_json
from runtime.measure import OIDN, main

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(which("cc") is None or which("make") is None, reason="there is no C compiler"),
]


def test_every_form_is_measured(tmp_path, capsys):
    main("64x48", str(tmp_path))
    rows = {row["form"]: row for row in read_json(tmp_path / "runtime" / "results.json")["rows"]}
    of_c = {"C, baseline", "Python wheel"}
    assert rows.keys() >= of_c | {"PyTorch, float32", "ONNX", *OIDN}
    assert all(row["ms"] > 0 for row in rows.values())
    assert all(rows[name]["megabytes"] < 3 and rows[name]["build_seconds"] > 0 for name in of_c)
    printed = capsys.readouterr().out
    assert all(name in printed for name in rows)
