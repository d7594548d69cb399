"""``en4dvar models``: every registered model with units, or the reason why it cannot be listed."""

from importlib.metadata import EntryPoint

import pytest
from click.testing import CliRunner

from en4dvar.cli import main
from en4dvar.config import models


def test_models_are_listed_with_parameters_and_units() -> None:
    done = CliRunner().invoke(main, ["models"])
    assert done.exit_code == 0, done.output
    assert ":`" not in done.output  # roles of reStructuredText
    blocks = {block.split(":")[0]: block for block in done.output.split("\n\n")}
    assert set(blocks) >= {"bubble", "linear", "lorenz63", "lorenz96"}
    lines = [" ".join(line.split()) for line in blocks["bubble"].splitlines()]
    assert "mu Pa s 0 … inf viscosity" in lines
    assert "radius um bubble radius" in lines
    assert any(line.startswith("settings: law, ") for line in lines)


def test_the_list_of_commands_cuts_no_sentence_short() -> None:
    done = CliRunner().invoke(main, ["--help"], terminal_width=80)
    assert done.exit_code == 0, done.output
    cut = [line for line in done.output.splitlines() if line.endswith(("...", "…")) and not line.startswith("Usage")]
    assert cut == []


def test_a_model_that_cannot_be_loaded_is_listed_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    entries = {"gone": EntryPoint("gone", "no_such_package:Model", models.GROUP)}
    monkeypatch.setattr(models, "installed", lambda group: entries)
    assert "gone: model 'gone' cannot be loaded: No module named 'no_such_package'" in models.model_listing()


def test_a_model_without_default_settings_is_listed_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    entries = {"picky": EntryPoint("picky", "toy_config:Picky", models.GROUP)}
    monkeypatch.setattr(models, "installed", lambda group: entries)
    import toy_config
    from pydantic import BaseModel

    from en4dvar.model.forward import ForwardModel

    class PickySettings(BaseModel):
        size: int

    class Picky(ForwardModel):
        """Needs a size."""

        Settings = PickySettings

        @classmethod
        def from_settings(cls, settings: PickySettings) -> ForwardModel:
            raise AssertionError("not reached")

    monkeypatch.setattr(toy_config, "Picky", Picky, raising=False)
    text = models.model_listing()
    assert text == "picky: Needs a size.\n  parameters depend on settings without default: size"
