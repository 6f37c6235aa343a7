"""Read captures in other programs' layouts, and convert them to native capture folders."""
