# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What is said of a file that is no YAML."""

import pytest

from fdi_ros.config.config import Config
from fdi_ros.errors import ConfigError


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a:\n  b: [1, 2\nc: 3\n", "line 3, column 2: while parsing a flow sequence, did not find"),
        ("a: 'x\n", "line 2, column 1: while scanning a quoted scalar, found unexpected end"),
        ("/**:\n\tx: 1\n", "line 2, column 1"),
        ("a: !!python/object x\n", "line 1, column 4: could not determine a constructor for the tag"),
    ],
)
def test_an_error_says_where_it_is_in_one_line(tmp_path, text, words) -> None:
    (tmp_path / "bad.yaml").write_text(text)
    with pytest.raises(ConfigError) as refused:
        Config.from_file(tmp_path / "bad.yaml")
    said = str(refused.value)
    assert said.startswith(f"config {tmp_path / 'bad.yaml'} is not YAML: ")
    assert words in said
    assert "unicode string" not in said
    assert "\n" not in said
