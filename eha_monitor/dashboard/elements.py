"""Small parts that the page is built of, and the dialog that acknowledges an alarm."""

from nicegui import ui

from eha_monitor.dashboard import words
from eha_monitor.dashboard.state import State


def tagged(element: ui.element, key: str) -> ui.element:
    """Give an element a name that stays, for tests and for whoever reads the page by program."""
    return element.props(f'data-testid="{key}"')


def text(content: str = "", classes: str = "", key: str = "") -> ui.label:
    """Make a text."""
    made = ui.label(content).classes(classes)
    return tagged(made, key) if key else made


def heading(rank: str, content: str) -> ui.label:
    """Make a heading, ``h1`` or ``h2``."""
    with ui.element(rank):
        return ui.label(content)


def button(label: str, key: str, on_click=None) -> ui.button:
    """Make a plain button, large enough for a finger."""
    made = ui.button(label, on_click=on_click, color=None).props("no-caps unelevated dense")
    return tagged(made.classes("plain"), key)


class Level:
    """A sign, a word and a colour; quiet, without the colour, where it is acknowledged."""

    def __init__(self, key: str):
        self._label = text("", "level", key)
        self._shown = ("", "", False)

    def show(self, level: str, content: str = "", quiet: bool = False) -> None:
        """Show a level, with other words than its own where they are given."""
        content = content or words.level_text(level)
        if (level, content, quiet) != self._shown:
            self._shown = level, content, quiet
            self._label.set_text(content)
            self._label.classes(replace=f"level level-{level.lower().replace(' ', '-')}"
                                        + (" quiet" if quiet else ""))


# ---- acknowledging an alarm: the name is kept in that browser for the next time ---------------

_LONGEST = 40  # characters of a name
_KEY = "eha_monitor_name"
_LOCAL = ("127.0.0.1", "::1", "")


def who_is(name: str, address: str) -> str:
    """Return how a person is written down: the name, and the machine if it is another one.

    >>> who_is(" Ada ", "127.0.0.1"), who_is("Ada", "10.0.0.7")
    ('Ada', 'Ada (10.0.0.7)')
    """
    name = " ".join(name.split())[:_LONGEST]
    return name if address in _LOCAL else f"{name} ({address})"


async def ask_for_acknowledgement(state: State, alarm: str) -> None:
    """Ask for the name, then acknowledge one alarm of an actuator."""
    client = ui.context.client
    try:
        known = await ui.run_javascript(f"localStorage.getItem('{_KEY}') || ''", timeout=2.0)
    except TimeoutError:
        known = ""
    with ui.dialog(value=True) as dialog, ui.element("div").classes("card dialog"):
        heading("h2", f"Acknowledge: {words.plain_name(alarm)}, {state.name}")
        name = tagged(ui.input("Your name", value=str(known)[:_LONGEST]).props(
            f"maxlength={_LONGEST} autofocus"), "who")

        def acknowledge() -> None:
            if not (name.value or "").strip():
                name.error = "expected a name, for those who look here later"
                return
            ui.run_javascript(f"localStorage.setItem('{_KEY}', "
                              "document.querySelector('[data-testid=who]').value)")
            state.acknowledge([alarm], who_is(name.value, client.ip or ""))
            dialog.close()

        name.on("keydown.enter", acknowledge)
        ui.label("The alarm stays on the page and no longer asks for attention, until it clears "
                 "or gets worse.").classes("note")
        with ui.element("div").classes("buttons"):
            button("Cancel", "cancel", dialog.close)
            button("Acknowledge", "confirm", acknowledge)
    dialog.on("hide", dialog.delete)
