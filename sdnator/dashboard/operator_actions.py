"""What people do on a page: sign in, undo, allow; each is told to the firewall and its answer shown."""

import asyncio
import time
from typing import TYPE_CHECKING, Literal

from nicegui import ui

from sdnator.dashboard.access_control import SIGN_IN

if TYPE_CHECKING:
    from apps.messages import Answer
    from sdnator.dashboard.page_backend import PageBackend

_ANSWER_SECONDS = 10.0


class OperatorActions:
    """One browser's right to act."""

    def __init__(self, service: "PageBackend", session: str) -> None:
        self._service = service
        self._session = session

    @property
    def allowed(self) -> bool:
        """Whether an operator has signed in here; asked anew with every deed, whatever the page shows."""
        return self._service.sessions.may_act(self._session, time.monotonic())

    @property
    def may_look(self) -> bool:
        """Whether this browser is still signed in."""
        return self._service.sessions.may_look(self._session, time.monotonic())

    def sign_out_button(self) -> None:
        """In the header: who sits there, and the way out."""
        sessions = self._service.sessions
        ui.label(f"{sessions.name_of(self._session)}, {sessions.role_of(self._session)}").classes("who")
        ui.button("Sign out", icon="logout", on_click=self._sign_out).props(
            "flat dense no-caps color=white"
        ).classes("sign-out")

    def _sign_out(self) -> None:
        sessions = self._service.sessions
        if name := sessions.name_of(self._session):
            self._service.note(name, "signed out", ui.context.client.ip or "")
        sessions.sign_out(self._session)
        ui.navigate.to(SIGN_IN)

    async def instruct(self, verb: Literal["unblock", "allow", "false_alarm"], subject: str) -> None:
        """Tell the firewall, and show what it says."""
        if not self.allowed:
            ui.notify("sign in as an operator first", type="warning")
            return
        loop = asyncio.get_running_loop()
        told: asyncio.Future[Answer] = loop.create_future()

        def tell(answer: "Answer") -> None:
            if not told.done():
                told.set_result(answer)

        def answered(answer: "Answer") -> None:
            loop.call_soon_threadsafe(tell, answer)

        who = self._service.sessions.name_of(self._session)
        name = await asyncio.to_thread(self._service.instruct, verb, subject, who, answered)
        try:
            answer = await asyncio.wait_for(told, _ANSWER_SECONDS)
        except TimeoutError:
            self._service.forget(name)
            ui.notify(f"the firewall did not answer within {_ANSWER_SECONDS:.0f} s", type="negative")
            return
        ui.notify(answer.text, type="positive" if answer.done else "negative")
