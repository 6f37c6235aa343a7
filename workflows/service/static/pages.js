// What all pages do: follow the queue, send actions, keys. Texts are inserted as text, never as markup.
"use strict";

const say = (text) => { document.getElementById("message").textContent = text; };

/* Follow the queue: after events the page is read again, and what has changed in it is replaced. */

const PAUSE_MS = 2500; // between two readings
let due = 0;

async function refresh() {
  due = 0;
  if (document.hidden) { due = -1; return; }
  const answer = await fetch(location.href, { headers: { Accept: "text/html" }, redirect: "manual" }).catch(() => null);
  if (answer && answer.type === "opaqueredirect") { location.reload(); return; } // the session has ended
  if (!answer || !answer.ok) return;
  const fresh = new DOMParser().parseFromString(await answer.text(), "text/html");
  for (const old of document.querySelectorAll("[data-live]")) {
    const part = fresh.querySelector(`[data-live="${old.dataset.live}"]`);
    if (!part || part.innerHTML === old.innerHTML) continue;
    const focus = old.contains(document.activeElement) ? document.activeElement.getAttribute("href") : null;
    old.replaceChildren(...part.childNodes);
    if (focus) old.querySelector(`[href="${CSS.escape(focus)}"]`)?.focus();
  }
}

function soon() {
  if (due === 0) due = setTimeout(refresh, PAUSE_MS);
}

function follow(address) {
  const source = new EventSource(address); // reconnects by itself, and continues after the last event
  const job = document.body.dataset.job;
  const about = (event) => { if (!job || JSON.parse(event.data).id === job) soon(); };
  source.addEventListener("job", about);
  source.addEventListener("deleted", about);
  source.addEventListener("reset", () => location.reload());
  addEventListener("pagehide", () => source.close());
  document.addEventListener("visibilitychange", () => { if (due === -1) { due = 0; soon(); } });
}

if (document.body.dataset.events) {
  follow(document.body.dataset.events);
  setInterval(() => { if (document.querySelector("[data-live]")) soon(); }, 30000); // times go on without events
}

/* Actions: a form's fields are sent as JSON, with the session's CSRF token. */

async function send(path, body) {
  const token = document.querySelector('meta[name="csrf-token"]')?.content ?? "";
  const headers = { "X-CSRF-Token": token, "Content-Type": "application/json", Accept: "application/json" };
  const answer = await fetch(path, { method: "POST", headers, body: JSON.stringify(body), redirect: "manual" });
  if (answer.type === "opaqueredirect") return {};
  const content = await answer.json().catch(() => ({}));
  if (answer.ok) return content;
  const parts = ["where", "expected", "got", "fix"].filter((name) => content[name]).map((name) => `${name} ${content[name]}`);
  throw new Error([content.detail ?? `status ${answer.status}`, ...parts].join("; "));
}

function fields(form) {
  const body = {};
  for (const input of form.elements) {
    if (!input.name) continue;
    if (input.type === "checkbox") body[input.name] = input.checked;
    else if (input.type === "number") body[input.name] = Number(input.value);
    else body[input.name] = input.value;
  }
  return body;
}

document.addEventListener("submit", async (event) => {
  const form = event.target;
  if (!form.classList.contains("act")) return;
  event.preventDefault();
  if (form.dataset.confirm && !confirm(form.dataset.confirm)) return;
  const button = form.querySelector("button");
  button.disabled = true;
  try {
    const content = await send(form.getAttribute("action"), fields(form));
    if (form.dataset.then) { location.assign(form.dataset.then); return; }
    if (content.url) { show(form, content.url); }
    say("count" in content ? `${button.textContent.trim()}: ${content.count} jobs` : `${button.textContent.trim()}: done`);
    due = due > 0 ? due : setTimeout(refresh, 300);
  } catch (error) {
    say(error.message);
  } finally {
    button.disabled = false;
  }
});

function show(form, address) {
  let link = form.querySelector("a.opened");
  if (!link) form.append(link = document.createElement("a"));
  link.className = "opened";
  link.rel = "noopener";
  link.target = "_blank";
  link.href = address;
  link.textContent = "Open the page";
  link.focus();
}

/* Keys: j, k and the arrows go through lists; [ and ] through their pages. */

const typing = () => /^(INPUT|SELECT|TEXTAREA|IFRAME)$/.test(document.activeElement?.tagName ?? "");

document.addEventListener("keydown", (event) => {
  if (event.altKey || event.ctrlKey || event.metaKey || typing()) return;
  const step = { j: 1, ArrowRight: 1, k: -1, ArrowLeft: -1 }[event.key];
  const links = [...document.querySelectorAll("[data-arrows] a")];
  if (step && links.length) {
    const at = links.indexOf(document.activeElement);
    links[at < 0 ? 0 : Math.min(links.length - 1, Math.max(0, at + step))].focus();
    event.preventDefault();
  }
  const turn = { "[": "prev", "]": "next" }[event.key];
  if (turn) document.querySelector(`a[rel="${turn}"]`)?.click();
});

/* Copy a command. */

document.addEventListener("click", async (event) => {
  const button = event.target.closest("[data-copy]");
  if (!button) return;
  const source = document.getElementById(button.dataset.copy);
  try {
    await navigator.clipboard.writeText(source.textContent);
    say("Copied.");
  } catch {
    getSelection().selectAllChildren(source);
    say("Selected: copy it with the keyboard.");
  }
});

/* A job's output, as it grows. */

const KEPT = 400000; // letters that are shown
async function readLog(element) {
  let offset = Number(element.dataset.offset ?? 0);
  for (;;) {
    const answer = await fetch(`${element.dataset.log}?offset=${offset}`).catch(() => null);
    const part = answer && answer.ok ? await answer.json() : null;
    if (part && part.text) {
      const below = element.scrollHeight - element.scrollTop - element.clientHeight < 30;
      element.textContent = (element.textContent + part.text).slice(-KEPT);
      offset = part.next_offset;
      if (below) element.scrollTop = element.scrollHeight;
      continue;
    }
    if (!element.textContent) element.dataset.empty = "nothing yet";
    const still = document.querySelector("[data-state]")?.dataset.state;
    await new Promise((wake) => setTimeout(wake, still === "running" && !document.hidden ? 1500 : 10000));
  }
}
document.querySelectorAll("[data-log]").forEach(readLog);
