"""The durable queue: the one room that imports dbos. docs/operations.md tells how it is run, docs/adr/0005 why it is so."""
