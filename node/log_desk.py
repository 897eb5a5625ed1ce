"""Answer questions about this node's own logs (protocol/log_pages.py): what others have missed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from buddyline.protocol.log_pages import GrowingLog, Question, pages_of


class LogDesk:
    """Answers from the logs of a node in a folder, those of earlier runs too. Pictures are not handed out."""

    def __init__(self, folder: Path, node: str) -> None:
        self._folder = folder
        self._node = node
        self._open: dict[str, GrowingLog] = {}

    def answer(self, text: str) -> Iterator[bytes]:
        """Yield the pages of an answer; none if there is no such log."""
        question = Question.of(text)
        log = None if question is None else self._log(question.boot)
        if question is None or log is None:
            return
        keys = {f"buddyline/node/{self._node}/{topic}" for topic in question.topics}
        yield from pages_of(log.messages(question.since_ns, question.until_ns, keys.__contains__))

    def _log(self, boot: str) -> GrowingLog | None:
        if boot not in self._open:
            path = next(self._folder.glob(f"{self._node}-*-{boot}.mcap"), None)
            if path is None:
                return None
            # The index of one log besides the one that is being written.
            self._open = dict(list(self._open.items())[-1:])
            self._open[boot] = GrowingLog(path)
        return self._open[boot]
