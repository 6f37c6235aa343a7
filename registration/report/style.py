"""What all pages share: their look, their frame, and their only script: a click enlarges a picture."""

from collections.abc import Mapping

CSS = """
:root { --ink: #22262d; --soft: #666c76; --line: #e2e2dc; --paper: #fbfbf9; --card: #ffffff; --accent: #1f7a74;
  --good: #1f7a74; --warn: #b7791f; --bad: #b3344a; }
* { box-sizing: border-box; }
html { scroll-behavior: smooth; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 15px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
main, .top { max-width: 1200px; margin: 0 auto; padding: 0 28px; }
header { background: var(--card); border-bottom: 1px solid var(--line); padding: 34px 0 30px; }
.eyebrow { color: var(--soft); font-size: 12.5px; letter-spacing: .09em; text-transform: uppercase; }
h1 { font-size: 31px; line-height: 1.2; margin: 6px 0 12px; font-weight: 680; letter-spacing: -.01em; }
h1 span { color: var(--soft); font-weight: 400; }
h2 { font-size: 20px; margin: 44px 0 6px; font-weight: 650; }
h2 + p, .hint { color: var(--soft); margin: 0 0 16px; max-width: 78ch; }
.wide { max-width: none; }
.lead { font-size: 17.5px; max-width: 72ch; margin: 0; }
.badge { display: inline-block; padding: 2px 12px; border-radius: 99px; color: #fff; font-size: 13.5px;
  font-weight: 600; vertical-align: 4px; margin-left: 10px; letter-spacing: .01em; }
.converged { background: var(--good); } .stopped { background: var(--warn); } .failed { background: var(--bad); }
nav { position: sticky; top: 0; z-index: 2; background: rgba(251,251,249,.93); border-bottom: 1px solid var(--line); }
nav .top { display: flex; gap: 22px; flex-wrap: wrap; padding-top: 9px; padding-bottom: 9px; font-size: 14px; }
a { color: var(--accent); text-decoration: none; } a:hover { text-decoration: underline; }
section { scroll-margin-top: 46px; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(158px, 1fr)); gap: 12px; margin-top: 24px; }
.tile { background: var(--paper); border: 1px solid var(--line); border-radius: 12px; padding: 13px 16px; }
.tile b { display: block; font-size: 25px; font-weight: 640; letter-spacing: -.02em; white-space: nowrap; }
.tile b small { font-size: 14px; font-weight: 400; color: var(--soft); letter-spacing: 0; }
.tile span { color: var(--soft); font-size: 13px; line-height: 1.35; display: block; }
.panel { background: var(--card); border: 1px solid var(--line); border-radius: 14px; padding: 18px 20px; }
.sides { display: grid; grid-template-columns: repeat(3, 1fr); gap: 8px; background: #f6f6f3; border-radius: 10px; }
figure { margin: 0; } figure img, .zoom { width: 100%; display: block; border-radius: 7px; }
figcaption { color: var(--soft); font-size: 12.5px; padding: 4px 2px 0; text-align: center; }
.bar { display: grid; grid-template-columns: auto minmax(160px, 360px) auto; gap: 12px; align-items: center;
  justify-content: center; margin-top: 14px; font-size: 13px; padding-bottom: 2px; }
.bar i { height: 11px; border-radius: 6px; display: block; }
.bar em { grid-column: 1 / -1; text-align: center; font-style: normal; color: var(--soft); }
.swatch { display: inline-block; width: 11px; height: 11px; border-radius: 3px; margin: 0 5px 0 14px;
  vertical-align: -1px; }
.ramp { display: inline-block; width: 120px; height: 10px; border-radius: 5px; }
.views { display: grid; grid-template-columns: repeat(auto-fill, minmax(520px, 1fr)); gap: 16px; }
.view h3 { margin: 0; font-size: 15.5px; font-weight: 650; }
.view header { all: unset; display: flex; justify-content: space-between; align-items: baseline; gap: 10px;
  flex-wrap: wrap; margin-bottom: 10px; }
.chips { color: var(--soft); font-size: 12.5px; } .chips b { color: var(--ink); font-weight: 600; }
.triple { display: grid; grid-template-columns: repeat(3, 1fr); gap: 8px; margin-bottom: 8px; }
.view details summary { margin: 2px 0 8px; }
.zoom { cursor: zoom-in; }
table { border-collapse: collapse; width: 100%; font-size: 14px; font-variant-numeric: tabular-nums; }
th { text-align: left; color: var(--soft); font-weight: 500; font-size: 12.5px; }
td, th { padding: 6px 10px 6px 0; border-bottom: 1px solid var(--line); vertical-align: top; }
tr:last-child td { border-bottom: 0; } .note { padding-left: 18px; color: var(--soft); } .num { text-align: right; }
.mono, pre { font-family: ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; font-size: 12.5px; }
td.mono { overflow-wrap: anywhere; } pre { margin: 12px 0 0; overflow-x: auto; line-height: 1.5; }
.times { display: grid; grid-template-columns: max-content 1fr max-content; gap: 8px 14px; align-items: center; }
.times i { height: 12px; background: var(--accent); border-radius: 6px; display: block; min-width: 2px; opacity: .8; }
.times span:nth-child(3n) { text-align: right; font-variant-numeric: tabular-nums; }
details + details { margin-top: 10px; } summary { cursor: pointer; font-weight: 600; }
.view summary { color: var(--accent); font-size: 13.5px; font-weight: 400; }
.panel svg { width: 100%; height: auto; display: block; }
footer { color: var(--soft); font-size: 13px; padding: 44px 0 40px; }
dialog { border: 0; outline: none; border-radius: 12px; padding: 12px; background: #fff;
  max-width: 96vw; max-height: 96vh; }
dialog img { max-width: calc(96vw - 24px); max-height: calc(90vh - 24px); min-height: 62vh; display: block; }
dialog p { margin: 8px 2px 0; color: var(--soft); font-size: 13.5px; }
dialog::backdrop { background: rgba(20, 22, 26, .72); }
@media (max-width: 640px) { .views { grid-template-columns: 1fr; } main, .top { padding: 0 14px; } }
@media print { nav { display: none; } .panel, .tile { break-inside: avoid; } body { background: #fff; } }
"""

SCRIPT = """
const dialog = document.querySelector("dialog");
document.addEventListener("click", (event) => {
  const picture = event.target.closest("img.zoom");
  if (picture) {
    dialog.querySelector("img").src = picture.src;
    dialog.querySelector("p").textContent = picture.alt;
    dialog.showModal();
  } else if (dialog.open) dialog.close();
});
"""


def document(title: str, body: str, *, css: str = "", zooms: bool = True) -> str:
    """A whole page of one file. `title` and `body` are HTML; `zooms`: it has pictures that a click enlarges."""
    dialog = f"<dialog><img alt=''><p></p></dialog><script>{SCRIPT}</script>" if zooms else ""
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{CSS}{css}</style></head>'
        f"<body>{body}{dialog}</body></html>"
    )


def sectioned(sections: Mapping[str, tuple[str, str]], *, footer: str = "") -> str:
    """Navigation and sections, title -> (text, content), all HTML; those without content are left out."""
    shown = {title: (title.split()[0].lower(), *part) for title, part in sections.items() if part[1]}
    links = "".join(f'<a href="#{place}">{title}</a>' for title, (place, _, _) in shown.items())
    body = "".join(
        f'<section id="{place}"><h2>{title}</h2>{text and f"<p>{text}</p>"}{content}</section>'
        for title, (place, text, content) in shown.items()
    )
    end = f"<footer>{footer}</footer>" if footer else ""
    return f"<nav><div class=top>{links}</div></nav><main>{body}{end}</main>"
