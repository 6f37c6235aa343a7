"""A service answers over HTTP: health, tokens, refusals."""

import json


def test_it_is_alive_and_says_what_it_offers(service):
    assert service.get("//healthz", role=None).json == {"status": "alive"}
    described = service.get("/openapi.json")
    assert described.status == 200 and "/api/v1/jobs" in json.loads(described.body)["paths"]


def test_no_token_and_too_low_a_role_are_refused(service):
    assert service.get("/runs", role=None).problem["status"] == 401
    refused = service.post("/cancel", {"run": "any"}, role="viewer").problem
    assert refused["status"] == 403 and refused["expected"] == "operator"


def test_malformed_json_is_refused_with_its_place(service):
    answer = service.post("/cancel", b'{"run": ', Content_Type="application/json").problem
    assert answer["status"] == 422 and answer["where"].startswith("body")
