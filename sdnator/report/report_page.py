"""The page of a report: one HTML file without anything outside it.  Pure: data in, text out.

Everything that comes from traffic or from a capture's name is escaped.
"""

import base64
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import Any

_STYLE = """
:root{color-scheme:light}
body{font:15px/1.5 system-ui,sans-serif;margin:0;color:#1c1c1c;background:#fff}
main{max-width:1180px;margin:0 auto;padding:28px 24px 60px}
h1{font-size:26px;line-height:1.25;margin:0 0 4px}
h2{font-size:17px;margin:34px 0 10px}
.from{color:#666;margin:0 0 22px}
.tiles{display:flex;flex-wrap:wrap;gap:12px;margin:0 0 22px}
.tile{border:1px solid #ddd;border-radius:8px;padding:10px 16px;min-width:150px;flex:1}
.tile b{display:block;font-size:24px;font-weight:650}
.tile span{color:#555;font-size:13px}
.good{border-left:5px solid #2e8b57}.bad{border-left:5px solid #d1342f}.plain{border-left:5px solid #3b78c3}
img{width:100%;height:auto;border:1px solid #eee}
table{border-collapse:collapse;width:100%;font-size:14px}
th,td{text-align:left;padding:6px 10px;border-bottom:1px solid #e6e6e6;vertical-align:top}
th{color:#555;font-weight:600}
td.n{font-variant-numeric:tabular-nums;white-space:nowrap}
code{font-size:13px;overflow-wrap:anywhere}
.wide{overflow-x:auto}
.note{background:#fff7e0;border-left:5px solid #e0a800;padding:8px 14px;margin:6px 0}
"""

_MOST_ROWS = 200


def render(
    *,
    title: str,
    summary: Mapping[str, Any],
    decisions: Sequence[Mapping[str, Any]],
    incidents: Sequence[Mapping[str, str]],
    notes: Sequence[str],
    png: bytes,
    passes: Sequence[tuple[str, Mapping[str, float]]],
) -> str:
    """The whole page."""
    picture = base64.b64encode(png).decode("ascii")
    parts = [
        "<!DOCTYPE html><html lang='en'><head><meta charset='utf-8'>",
        "<meta name='viewport' content='width=device-width,initial-scale=1'>",
        f"<title>SDNator: {escape(title)}</title><style>{_STYLE}</style></head><body><main>",
        f"<h1>{escape(verdict(summary))}</h1><p class='from'>Replay of {escape(title)}</p>",
        f"<div class='tiles'>{''.join(_tiles(summary))}</div>",
        *(f"<p class='note'>{escape(note)}</p>" for note in notes),
        f"<img alt='Anomaly score of each packet over time' src='data:image/png;base64,{picture}'>",
        _explanation(summary),
        _incidents(incidents),
        _blocks(summary),
        _guards(summary),
        _limits(summary),
        _decisions(decisions),
        _figures(summary, passes),
        "<p>Beside this page: <code>scores.csv</code>, <code>decisions.csv</code>, <code>eve.json</code>, ",
        "<code>scores.png</code>.</p></main></body></html>\n",
    ]
    return "\n".join(part for part in parts if part)


def verdict(summary: Mapping[str, Any]) -> str:
    """What happened, in one sentence."""
    blocks, alerts = summary.get("blocks") or [], int(summary.get("alerts") or 0)
    attack = summary.get("attack_packets")
    if blocks:
        senders = len({block["address"] for block in blocks})
        return f"{_count(senders, 'sender')} blocked{_delay(summary)}{_stopped(summary)}"
    if limits := summary.get("limits"):
        return _limited(limits)
    if guards := summary.get("guards"):
        syns = _count(int(summary.get("packets_would_be_challenged") or 0), "SYN")
        return f"{_count(len(guards), 'service')} under a SYN flood: a guard would have challenged {syns}"
    if summary.get("mitigation") is False:
        return f"Kitsune alone, nothing blocked: {_count(alerts, 'alert')}"
    if attack:
        return (
            f"The attack was not blocked: {_count(int(attack), 'attack packet')}, {_count(alerts, 'alert')}"
        )
    return f"Nothing to block: {_count(alerts, 'alert')}"


def _limited(limits: Sequence[Mapping[str, Any]]) -> str:
    victims = _count(len({limit["address"] for limit in limits}), "victim")
    dropped = sum(int(limit["packets_dropped"]) for limit in limits)
    would = sum(int(limit["packets_would_be_dropped"]) for limit in limits)
    if would and not dropped:
        return f"{victims} of a flood: a rate limit would have dropped {_count(would, 'packet')}"
    return f"{victims} of a flood: {_count(dropped, 'packet')} over the rate limit dropped"


def _delay(summary: Mapping[str, Any]) -> str:
    delay = (summary.get("time_to_block_s") or {}).get("capture")
    return "" if delay is None else f" {delay:.1f} s after the first attack packet"


def _stopped(summary: Mapping[str, Any]) -> str:
    share = _share(summary.get("attack_dropped"), summary.get("attack_after_first_block"))
    if share is None:
        return ""
    hit = summary.get("benign_dropped")
    others = (
        "" if hit is None else "; nobody else was hit" if hit == 0 else f"; {hit:,} benign packets were hit"
    )
    return f"; {share} of the attack stopped from then on{others}"


def _share(part: Any, whole: Any) -> str | None:
    """A percentage that says 100 only when nothing is missing."""
    if part is None or not whole:
        return None
    percent = 100 * part / whole
    if part < whole:
        percent = min(percent, 99.9)
    return f"{percent:.1f} %" if percent < 100 else "100 %"


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def _tile(kind: str, value: str, text: str) -> str:
    return f"<div class='tile {kind}'><b>{escape(value)}</b><span>{escape(text)}</span></div>"


def _tiles(summary: Mapping[str, Any]) -> Iterator[str]:
    delay = (summary.get("time_to_block_s") or {}).get("capture")
    if delay is not None:
        yield _tile("plain", f"{delay:.1f} s", "from the first attack packet to the block (capture time)")
    share = _share(summary.get("attack_dropped"), summary.get("attack_after_first_block"))
    if share is not None:
        yield _tile(
            "good" if summary["attack_dropped"] >= 0.95 * summary["attack_after_first_block"] else "bad",
            share,
            f"of {summary['attack_after_first_block']:,} attack packets after the block were dropped",
        )
    if (hit := summary.get("benign_dropped")) is not None:
        yield _tile("good" if hit == 0 else "bad", f"{hit:,}", "packets of benign senders dropped")
    if (collateral := summary.get("collateral_dropped")) is not None:
        yield _tile("plain", f"{collateral:,}", "benign packets of the attacker itself dropped with it")
    if (lost := summary.get("packets_lost")) is not None:
        yield _tile("good" if lost == 0 else "bad", f"{lost:,}", "packets lost on the way")
    if (area := summary.get("auc")) is not None:
        yield _tile("plain", f"{area:.3f}", "ROC AUC of the scores (Kitsune alone)")


def _explanation(summary: Mapping[str, Any]) -> str:
    both = "The upper plot is Kitsune alone, the lower one the same capture with blocking. "
    return (
        f"<p>Each dot is a packet, with the anomaly score that Kitsune gave it; packets at or above the dashed "
        f"line, the threshold, are anomalous. {both if summary.get('mitigation') else ''}"
        "Packets that the switch drops are not scored and are drawn below the scale. "
        f"{_passed_in_flight(summary)}"
        "Answers of an attack's victims count as benign.</p>"
    )


def _passed_in_flight(summary: Mapping[str, Any]) -> str:
    if not summary.get("blocks") or "passed_in_flight" not in summary:
        return ""
    return (
        f"{_count(int(summary['passed_in_flight']), 'packet')} of blocked senders passed in flight: they came after "
        f"the one that made a block due, and before it took effect ({summary['reaction_s']:g} s of capture time at "
        f"most); {_count(int(summary['most_in_flight']), 'packet')} of all senders at most were on their way then. "
    )


def _incidents(rows: Sequence[Mapping[str, str]]) -> str:
    if not rows:
        return ""
    names = ("time", "kind", "attacker", "victims", "done", "stopped")
    heads = ("Begun", "Kind", "Attacker", "Victims", "What was done", "Packets stopped")
    head = "".join(f"<th>{name}</th>" for name in heads)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(each[name])}</td>" for name in names) + "</tr>"
        for each in rows[:_MOST_ROWS]
    )
    more = f"<p>… and {len(rows) - _MOST_ROWS:,} more in eve.json</p>" if len(rows) > _MOST_ROWS else ""
    return f"<h2>Incidents</h2><div class='wide'><table><tr>{head}</tr>{body}</table></div>{more}"


def _blocks(summary: Mapping[str, Any]) -> str:
    blocks = summary.get("blocks") or []
    if not blocks:
        return ""
    rows = "".join(
        f"<tr><td><b>{escape(str(block['address']))}</b></td><td class='n'>{escape(str(block['time']))}</td>"
        f"<td class='n'>{escape(_number(block['packet']))}</td><td>{escape(str(block['reason']))}</td>"
        f"<td><code>{escape(str(block['handle']))}</code></td></tr>"
        for block in blocks
    )
    head = "<tr><th>Blocked</th><th>Capture time</th><th>At packet</th><th>Why</th><th>Entry in the switch</th></tr>"
    return f"<h2>Blocks</h2><div class='wide'><table>{head}{rows}</table></div>"


def _guards(summary: Mapping[str, Any]) -> str:
    guards = summary.get("guards") or []
    if not guards:
        return ""
    rows = "".join(
        f"<tr><td><b>{escape(str(guard['address']))}</b> port {guard['port']}</td>"
        f"<td class='n'>{escape(str(guard['decided']))}</td><td class='n'>{escape(_number(guard['packet']))}</td>"
        f"<td>{escape(str(guard['reason']))}</td>"
        f"<td class='n'>{guard['packets_would_be_challenged']:,}</td></tr>"
        for guard in guards
    )
    head = (
        "<tr><th>Would be guarded</th><th>Capture time</th><th>From packet</th><th>Why</th>"
        "<th>SYNs that it would have challenged</th></tr>"
    )
    why = "<p>Clients in a capture cannot answer a challenge, so guards are decided but not set, and SYNs pass.</p>"
    return f"<h2>Guards</h2>{why}<div class='wide'><table>{head}{rows}</table></div>"


def _limits(summary: Mapping[str, Any]) -> str:
    limits = summary.get("limits") or []
    if not limits:
        return ""
    rows = "".join(
        f"<tr><td><b>{escape(str(limit['address']))}</b> {escape(str(limit['packets']))}</td>"
        f"<td class='n'>{limit['rate']:,}/s</td><td class='n'>{escape(str(limit['decided']))}</td>"
        f"<td class='n'>{escape(_number(limit['packet']))}</td><td>{escape(str(limit['reason']))}</td>"
        f"<td class='n'>{limit['packets_dropped'] or limit['packets_would_be_dropped']:,}"
        f"{' (would be)' if limit['effect'] == 'would limit' else ''}</td></tr>"
        for limit in limits
    )
    head = (
        "<tr><th>Limited towards</th><th>Rate</th><th>Capture time</th><th>From packet</th><th>Why</th>"
        "<th>Packets dropped</th></tr>"
    )
    return f"<h2>Rate limits</h2><div class='wide'><table>{head}{rows}</table></div>"


def _decisions(rows: Sequence[Mapping[str, Any]]) -> str:
    if not rows:
        return ""
    names = ("time", "action", "address", "state", "expires", "reason", "cause")
    head = "".join(f"<th>{name}</th>" for name in names)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(str(row[name]))}</td>" for name in names) + "</tr>"
        for row in rows[:_MOST_ROWS]
    )
    more = f"<p>… and {len(rows) - _MOST_ROWS:,} more in decisions.csv</p>" if len(rows) > _MOST_ROWS else ""
    return f"<h2>Decisions</h2><div class='wide'><table><tr>{head}</tr>{body}</table></div>{more}"


def _figures(summary: Mapping[str, Any], passes: Sequence[tuple[str, Mapping[str, float]]]) -> str:
    rows = [
        (name.replace("_", " "), _number(value))
        for name, value in summary.items()
        if isinstance(value, int | float | str) and not isinstance(value, bool)
    ]
    rows += [(f"{title}: {name}", f"{value:.4g}") for title, facts in passes for name, value in facts.items()]
    body = "".join(
        f"<tr><td>{escape(name)}</td><td class='n'>{escape(value)}</td></tr>" for name, value in rows
    )
    return f"<h2>Figures</h2><table>{body}</table>"


def _number(value: Any) -> str:
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:,.4g}" if isinstance(value, float) else str(value)
