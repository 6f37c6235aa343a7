"""The durable queue: the one room that imports dbos. How it is run: docs/operations.md; why so: docs/adr."""
