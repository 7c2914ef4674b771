"""`onespp export` and its bench, from the command line on."""

import json

import numpy as np
import pytest
import torch

from command_line import main
from tests.eval.conftest import untrained
from tests.helpers.exports import check_page
from tests.test_cli import fails


def test_untrained_and_unknown(capsys, tmp_path, shipped):
    runs = ["--runs", str(tmp_path), "--to", "pt2"]
    assert "wskp3: it has no weights at" in fails(capsys, "export", "wskp3", *runs)
    assert "`onespp train wskp3 --budget tiny" in fails(capsys, "export", "wskp3@tiny", *runs)
    assert "'svgf' cannot be exported; wskp3, wskp6, one can" in fails(capsys, "export", "svgf", *runs)
    assert "there are no weights at" in fails(capsys, "export", "wskp3", *runs, "--weights", str(tmp_path / "w"))
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.slow
def test_trained_weights_become_a_file_in_place_of_an_older_one(capsys, tmp_path):
    untrained(tmp_path, "wskp3")
    call = ["export", "wskp3@tiny", "--to", "pt2", "--runs", str(tmp_path)]
    export = tmp_path / "export" / "wskp3@tiny-pt2"
    export.mkdir(parents=True)
    (export / "manifest.json").write_text('{"sha256": {"old.pt2": "0"}}')
    (export / "old.pt2").write_bytes(b"")
    main(call)
    assert capsys.readouterr().out.startswith(f"{export}/wskp3.pt2: ")
    manifest = json.loads((export / "manifest.json").read_text())
    assert manifest["largest_difference"]["from_onespp"] < 1e-4
    files = {str(path.relative_to(export)) for path in export.rglob("*") if path.is_file()}
    assert files == {"manifest.json", "README.md", "wskp3.pt2", *(f"golden/00{n}.npz" for n in range(4))}
    assert [path.name for path in (tmp_path / "export").iterdir()] == ["wskp3@tiny-pt2"]
    check_page(export, lambda array: torch.from_numpy(np.ascontiguousarray(array)), 1e-4)
