"""Build the first model from MakeHuman's head, with procedural eyes, teeth and tongue."""
