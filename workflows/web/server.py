"""Pages that viser serves from this machine alone, over one port; they ask nobody else for anything."""

import time
from typing import TYPE_CHECKING

from registration.errors import InputError

if TYPE_CHECKING:
    from viser import ViserServer

HOST = "127.0.0.1"


def serve(port: int, title: str) -> "ViserServer":
    """An empty page with our colours and light. `port` 0 takes a free one.

    Raises InputError if the port cannot be had: viser would look for the next free one, but a tunnel leads to the one
    that was asked for.
    """
    import socket

    import viser

    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
            port = probe.getsockname()[1]
        except (OSError, OverflowError) as error:
            raise InputError(
                "The page cannot be served",
                where=f"{HOST}:{port}",
                expected="a free port",
                got=error,
                fix="choose another one with --port",
            ) from error
    server = viser.ViserServer(host=HOST, port=port, label=title, verbose=False)
    server.gui.configure_theme(
        brand_color=(31, 122, 116), show_logo=False, show_share_button=False, control_width="large"
    )
    server.gui.main_panel.dock_right()
    server.scene.configure_default_lights(False)
    server.scene.configure_environment_map(None)  # colours mean millimetres: light must not wash them out
    server.scene.add_light_ambient("/ambient", intensity=1.7)
    return server


def until_interrupted() -> None:
    """Wait for Ctrl-C."""
    while True:
        time.sleep(1)
