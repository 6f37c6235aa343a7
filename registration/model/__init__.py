"""The GNM head model: its function, its file, its regions and landmark schemes."""
