"""How long the server waits for a request to be said, and with how many it speaks at once.

uvicorn limits neither: who opens connections and never ends a header would hold them for ever.
"""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.auto import AutoHTTPProtocol

__all__ = ["Patient"]

LONGEST_HEAD = 10.0
"""Seconds for a request's head to arrive."""
MOST_HEAD = 256 * 1024
"""Bytes of it."""
MOST_CONNECTIONS = 200
"""At once."""


class Patient(AutoHTTPProtocol):  # type: ignore[misc, valid-type]
    """uvicorn's connection, closed where a request's head is too long in coming or too long."""

    _late: asyncio.TimerHandle | None = None
    _size = 0

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        if len(self.connections) > MOST_CONNECTIONS:
            transport.abort()
        else:
            self._awaited(0)

    def connection_lost(self, error: Exception | None) -> None:
        self._said()
        super().connection_lost(error)

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        upgraded = self.transport.get_protocol() is not self  # a websocket's from here on
        if upgraded or not (self.cycle is None or self.cycle.response_complete):
            self._said()
        else:
            self._awaited(len(data))

    def _awaited(self, size: int) -> None:
        self._size += size
        if self._late is None:
            loop = asyncio.get_running_loop()
            self._late = loop.call_later(LONGEST_HEAD, self.transport.abort)
        if self._size > MOST_HEAD:
            self.transport.abort()

    def _said(self) -> None:
        self._size = 0
        if self._late is not None:
            self._late.cancel()
            self._late = None
