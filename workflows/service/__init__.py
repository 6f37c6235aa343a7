"""The farm over HTTP: an API, pages for people, and what operators of services need (docs/service.md)."""
