"""Pages that viser serves on the loopback interface, over one port, to those who know their token."""

import io
import re
import socket
import time
from contextlib import redirect_stdout

import viser

from registration.errors import InputError
from registration.terminal import printable
from workflows.web.page_access import PARAMETER, PageAccess, guarded_servers

_HOST = "127.0.0.1"


def literal(text: str) -> str:
    """Return any text as Markdown that shows it as it is: a name must not load a picture from another host."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", printable(text))


class PageServer:
    """An empty page with the project's colours and light."""

    def __init__(self, port: int, title: str):
        """Start the server.

        Args:
            port: port on the loopback interface; 0: any free one.
            title: of the browser's tab.

        Raises:
            InputError: the port is in use. viser would take the next free one, but a tunnel leads to this one.
        """
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((_HOST, port))
                port = probe.getsockname()[1]
            except (OSError, OverflowError) as error:
                raise InputError(
                    "The page cannot be served",
                    where=f"{_HOST}:{port}",
                    expected="a free port",
                    got=error,
                    fix="choose another one with --port",
                ) from error
        self._access = PageAccess()
        with guarded_servers(self._access), redirect_stdout(io.StringIO()):  # viser prints a URL without the token
            self._server = viser.ViserServer(host=_HOST, port=port, label=title, verbose=False)
        self.port = self._server.get_port()
        gui, scene = self._server.gui, self._server.scene
        gui.configure_theme(brand_color=(31, 122, 116), show_logo=False, show_share_button=False, control_width="large")
        gui.main_panel.dock_right()
        scene.configure_default_lights(False)
        scene.configure_environment_map(None)  # colours encode millimetres: reflections would change them
        scene.add_light_ambient("/ambient", intensity=1.7)

    @property
    def url(self) -> str:
        """The page's URL, with the token that it asks for."""
        return f"http://{_HOST}:{self.port}/?{PARAMETER}={self._access.token}"

    def wait(self) -> None:
        """Block until Ctrl-C, then close."""
        try:
            while True:
                time.sleep(1)
        finally:
            self.close()

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()
