"""Options of a command from the fields of a model: what does not fit is refused in the words of the command line."""

from __future__ import annotations

from typing import Self

import pytest
from pydantic import BaseModel, Field, model_validator

from boxplus.cli.model_options import takes_options
from boxplus.errors import InputError


class _Window(BaseModel):
    start_s: float = Field(0.0, ge=0.0, description="skip this much [s]")
    end_s: float = Field(1.0, description="read up to here [s]")

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.end_s <= self.start_s:
            raise ValueError("nothing is left between start and end")
        return self


@takes_options(_Window)
def _command(options: _Window) -> None:
    pass


def test_a_value_out_of_range_is_named_by_its_option() -> None:
    with pytest.raises(InputError, match=r"a valid value for --start \(skip this much \[s\]\) – got -1.0"):
        _command(start_s=-1.0, end_s=1.0)


def test_what_is_wrong_with_no_option_alone_is_refused_as_well() -> None:
    with pytest.raises(InputError, match=r"for these options together – got .*nothing is left between start and end"):
        _command(start_s=2.0, end_s=1.0)
