"""Values of options: what an empty text is not."""

import argparse
from pathlib import Path

import pytest

from common.options import output_folder


def test_a_folder_may_be_anywhere():
    assert [output_folder(text) for text in (".", "runs/x")] == [Path(), Path("runs/x")]


def test_an_empty_text_is_no_folder():
    with pytest.raises(argparse.ArgumentTypeError, match=r"expected a folder, got an empty text; the current one is"):
        output_folder("")
