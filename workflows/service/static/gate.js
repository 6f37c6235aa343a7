// Decisions at the gate: buttons and the keys a, r, n, u.
"use strict";

const decideForm = document.getElementById("decide");
const unread = document.querySelector("[data-unread]");
if (unread) setTimeout(() => location.reload(), 1500);

async function decide(decision) {
  const { job, content, next, lastJob, lastContent, run, show } = decideForm.dataset;
  const reason = document.getElementById("reason");
  if (decision === "next") { location.assign(next); return; }
  if (decision === "undo" && !lastJob) { say("There is no decision of yours to undo."); return; }
  if (decision === "reject" && !reason.value.trim()) {
    reason.dataset.then = "reject";
    reason.focus();
    say("Why? Type the reason; Enter rejects.");
    return;
  }
  const undo = decision === "undo";
  const body = { job: undo ? lastJob : job, content_id: undo ? lastContent : content, decision, reason: reason?.value ?? "" };
  try {
    await send("/api/v1/gate/decisions", body);
    const query = new URLSearchParams({ show, job: lastJob ?? "" });
    location.assign(undo ? `/gate/${encodeURIComponent(run)}?${query}` : next);
  } catch (error) {
    say(error.message);
  }
}

if (decideForm) {
  decideForm.addEventListener("submit", (event) => {
    event.preventDefault();
    decide(document.getElementById("reason")?.dataset.then ?? "accept");
  });
  decideForm.addEventListener("click", (event) => {
    const button = event.target.closest("[data-decision]");
    if (button) decide(button.dataset.decision);
  });
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape") document.activeElement?.blur();
    if (event.altKey || event.ctrlKey || event.metaKey || typing()) return;
    const decision = { a: "accept", r: "reject", n: "next", u: "undo" }[event.key];
    if (decision && decideForm.querySelector(`[data-decision="${decision}"]`)) {
      event.preventDefault();
      decide(decision);
    }
  });
}
