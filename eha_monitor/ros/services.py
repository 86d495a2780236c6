"""Services beyond rclpy's own: answers that come later."""

from collections.abc import Callable

from rclpy.node import Node
from std_srvs.srv import Trigger


class LateTrigger:
    """A Trigger service that answers when the work is done, while the node goes on.

    The events executor knows no coroutines: it hands whatever the callback returns to the
    service's ``send_response``, so the header is kept there until the answer is known.

    Parameters
    ----------
    node : node to offer it on.
    name : of the service.
    begin : called for each request; returns a message if it is refused at once, else None.
    """

    def __init__(self, node: Node, name: str, begin: Callable[[], str | None]):
        self._begin = begin
        self._waiting: list = []
        self._taken: list = []
        self.service = node.create_service(Trigger, name, self._on_request)
        self._send = self.service.send_response
        self.service.send_response = self._keep_or_send

    def take_up(self) -> None:
        """Work begins for the requests that wait now; those that come later wait for the next."""
        self._taken, self._waiting = self._taken + self._waiting, []

    def answer(self, success: bool, message: str) -> None:
        """Answer every request that was taken up."""
        taken, self._taken = self._taken, []
        for header in taken:
            self._send(Trigger.Response(success=success, message=message), header)

    def _on_request(self, request, response):
        refused = self._begin()
        if refused is None:
            return None
        response.success, response.message = False, refused
        return response

    def _keep_or_send(self, response, header) -> None:
        if response is None:
            self._waiting.append(header)
        else:
            self._send(response, header)
