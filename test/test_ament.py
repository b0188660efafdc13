# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The linters of ROS packages, where they are installed (ament_lint; not among what pip installs)."""

import pytest

pytestmark = pytest.mark.linter


def test_copyright(root, monkeypatch):
    """Each file has a copyright line and names its licence: by the SPDX identifier, where ament has the long text."""
    main = pytest.importorskip("ament_copyright.main", reason="ament_copyright is not installed").main
    parser = pytest.importorskip("ament_copyright.parser")
    known = parser.get_licenses()
    apache = known["apache2"]._replace(file_headers=["SPDX-License-Identifier: Apache-2.0"])
    monkeypatch.setattr(parser, "get_licenses", lambda: known | {"apache2": apache})
    monkeypatch.chdir(root)
    assert main(argv=["."]) == 0


def test_flake8(root, monkeypatch):
    main = pytest.importorskip("ament_flake8.main", reason="ament_flake8 is not installed").main_with_errors
    monkeypatch.chdir(root)
    code, errors = main(argv=["--config", ".flake8", "."])
    assert code == 0, "\n".join(errors)


def test_pep257(root):
    """As ruff has it, which knows properties, whose first line is a noun (D401)."""
    main = pytest.importorskip("ament_pep257.main", reason="ament_pep257 is not installed").main
    assert main(argv=[str(root / "fdi_ros"), "--convention", "numpy", "--add-ignore", "D105", "D401"]) == 0
