"""The frame of pages that are not templates yet."""

from collections.abc import Mapping

from registration.report.templates import environment

CSS, SCRIPT = (environment().get_template(name).render() for name in ("style.css", "zoom.js"))


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
