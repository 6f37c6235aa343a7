"""The pages of the service, for people: routes below /, without scripts or styles of their own in the text."""
