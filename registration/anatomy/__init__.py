"""The structure of a model's eyes, teeth and tongue, found from its mesh [GNM, Internal Anatomy]."""
