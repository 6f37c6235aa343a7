"""Pages that viser serves from this machine alone, over one port; they ask nobody else for anything."""

import socket
import time

import viser

from registration.errors import InputError

_HOST = "127.0.0.1"


class Served:
    """A page with our colours and light, empty as yet."""

    def __init__(self, port: int, title: str):
        """`port` 0 takes a free one.

        Raises InputError if the port cannot be had: viser would look for the next free one, but a tunnel leads to the
        one that was asked for.
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
        self._server = viser.ViserServer(host=_HOST, port=port, label=title, verbose=False)
        self.port = self._server.get_port()
        gui, scene = self._server.gui, self._server.scene
        gui.configure_theme(brand_color=(31, 122, 116), show_logo=False, show_share_button=False, control_width="large")
        gui.main_panel.dock_right()
        scene.configure_default_lights(False)
        scene.configure_environment_map(None)  # colours mean millimetres: light must not wash them out
        scene.add_light_ambient("/ambient", intensity=1.7)

    @property
    def url(self) -> str:
        """Where to open it."""
        return f"http://{_HOST}:{self.port}"

    def wait(self) -> None:
        """Until Ctrl-C."""
        try:
            while True:
                time.sleep(1)
        finally:
            self.close()

    def close(self) -> None:
        self._server.stop()
