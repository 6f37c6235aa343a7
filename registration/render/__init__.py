"""The differentiable renderer; the only room that imports Mitsuba and Dr.Jit."""
