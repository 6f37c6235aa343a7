"""The colours of charts."""

TEXT_COLOUR, GRID_COLOUR = "#2b2f36", "#d9d9d4"
LINE_COLOURS = (
    "#1f77b4",
    "#d1495b",
    "#2a9d8f",
    "#e9a23b",
    "#6a4c93",
    "#8c6d46",
    "#4c956c",
    "#b56576",
    "#5c677d",
    "#9a031e",
)
