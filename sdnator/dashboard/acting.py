"""What people do on a page: sign in, undo, allow; each is told to the firewall and its answer shown."""

import asyncio
import time
from typing import TYPE_CHECKING, Literal

from nicegui import ui

if TYPE_CHECKING:
    from apps.messages import Answer
    from sdnator.dashboard.page_backend import PageBackend

_ANSWER_SECONDS = 10.0
_WRONG_SECONDS = 1.0


class Acting:
    """One browser's right to act."""

    def __init__(self, service: "PageBackend", session: str) -> None:
        self._service = service
        self._session = session

    @property
    def allowed(self) -> bool:
        """Whether this browser has signed in; asked anew with every deed, whatever the page shows."""
        return self._service.sessions.may_act(self._session)

    def sign_in_button(self) -> None:
        """In the header: sign in, or out."""
        if self.allowed:
            ui.button("Sign out", icon="logout", on_click=self._sign_out).props(
                "flat dense no-caps color=white"
            ).classes("sign-out")
            return
        with ui.dialog() as dialog, ui.card().style("min-width: min(360px, 90vw)"):
            ui.label("Sign in").classes("text-subtitle1 text-weight-medium")
            ui.label("The token stands in the file that `sdnator up` and `sdnator status` name.").classes(
                "quiet"
            )
            field = ui.input("Token", password=True).props("autofocus outlined dense").classes("token w-full")
            fault = ui.label("").classes("fault")

            async def try_it() -> None:
                sessions, source = self._service.sessions, ui.context.client.ip
                await asyncio.sleep(sessions.delay_s(source, time.monotonic()))
                wrong = sessions.sign_in(self._session, str(field.value or ""), source)
                if not wrong:
                    ui.navigate.reload()
                    return
                await asyncio.sleep(_WRONG_SECONDS)
                field.set_value("")
                fault.set_text(wrong)

            field.on("keydown.enter", try_it)
            with ui.row().classes("w-full justify-end"):
                ui.button("Cancel", on_click=dialog.close).props("flat no-caps")
                ui.button("Sign in", on_click=try_it).props("unelevated no-caps").classes("sign-in-now")
        ui.button("Sign in", icon="login", on_click=dialog.open).props(
            "flat dense no-caps color=white"
        ).classes("sign-in")

    def _sign_out(self) -> None:
        self._service.sessions.sign_out(self._session)
        ui.navigate.reload()

    async def instruct(self, verb: Literal["unblock", "allow", "false_alarm"], subject: str) -> None:
        """Tell the firewall, and show what it says."""
        if not self.allowed:
            ui.notify("sign in first", type="warning")
            return
        loop = asyncio.get_running_loop()
        told: asyncio.Future[Answer] = loop.create_future()

        def tell(answer: "Answer") -> None:
            if not told.done():
                told.set_result(answer)

        def answered(answer: "Answer") -> None:
            loop.call_soon_threadsafe(tell, answer)

        name = await asyncio.to_thread(self._service.instruct, verb, subject, answered)
        try:
            answer = await asyncio.wait_for(told, _ANSWER_SECONDS)
        except TimeoutError:
            self._service.forget(name)
            ui.notify(f"the firewall did not answer within {_ANSWER_SECONDS:.0f} s", type="negative")
            return
        ui.notify(answer.text, type="positive" if answer.done else "negative")
