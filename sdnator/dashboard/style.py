"""The look of the pages, beyond what NiceGUI brings.  Colours with alpha do for light and dark."""

STYLE = """
body { font-variant-numeric: tabular-nums; }
.w-full { width: 100%; }
.bar { padding: 2px 16px; display: flex; align-items: center; }
.degraded:not(:empty) { background: #b71c1c; border-radius: 4px; padding: 1px 8px; margin-left: 12px; font-size: .85rem; }
.q-tab-panels { background: transparent !important; overflow: visible; }
.nicegui-content { padding: 12px; gap: 12px; max-width: 1500px; margin: 0 auto; width: 100%; }
.board { display: grid; gap: 12px; width: 100%; grid-template-columns: minmax(0, 3fr) minmax(0, 2fr); }
.board > .wide { grid-column: 1 / -1; }
.board > .stack { display: grid; gap: 12px; align-content: start; min-width: 0; }
.health { border-radius: 8px; padding: 10px 14px; font-size: 1.05rem; font-weight: 500; width: 100%; color: #fff; }
.health.well { background: #1b6e3a; } .health.notice { background: #8a5200; } .health.trouble { background: #b71c1c; }
.scores svg text, .flow svg text { fill: currentColor !important; stroke: none !important; }
.flow svg text { paint-order: stroke; stroke: #fff !important; stroke-width: 3px !important; }
.body--dark .flow svg text { stroke: #121212 !important; }
.body--dark .text-primary { --q-primary: #8dbdf0; }
summary { cursor: pointer; list-style: none; text-decoration: underline; }
:focus-visible { outline: 2px solid #2f6fb3; outline-offset: 1px; }
.body--dark :focus-visible { outline-color: #8dbdf0; }
.figures { display: grid; gap: 8px; width: 100%; grid-template-columns: repeat(auto-fit, minmax(120px, 1fr)); }
.figure { border: 1px solid rgba(128, 128, 128, .25); border-radius: 8px; padding: 8px 12px; }
.figure .number { font-size: 1.45rem; font-weight: 500; line-height: 1.3; }
.figure .name { font-size: .75rem; opacity: .7; }
.q-tab-panel > .panel { width: 100%; }
.panel { border: 1px solid rgba(128, 128, 128, .25); border-radius: 8px; padding: 12px; min-width: 0; }
.panel-title { font-weight: 500; font-size: .95rem; margin-bottom: 4px; }
.quiet { opacity: .7; font-size: .8rem; }
.fault { color: #c62828; }
.body--dark .fault { color: #ef9a9a; }
.feed { width: 100%; }
.feed .q-table__top, .feed thead { display: none; }
.feed td { white-space: normal !important; padding: 6px 4px !important; height: auto !important; }
.entry { display: flex; gap: 10px; align-items: flex-start; width: 100%; }
.entry .text { flex: 1 1 auto; min-width: 0; overflow-wrap: anywhere; line-height: 1.35; }
.entry .text .second { opacity: .75; font-size: .8rem; }
.entry .side { flex: 0 0 auto; display: flex; gap: 4px; flex-wrap: wrap; justify-content: flex-end; }
.mark { flex: 0 0 auto; width: 4px; align-self: stretch; border-radius: 2px; background: #8884; }
.mark.block { background: #d32f2f; } .mark.protect { background: #1976d2; } .mark.alert { background: #f9a825; }
.mark.incident { background: #6a4fb3; }
.plain { width: 100%; }
.plain td { white-space: normal !important; overflow-wrap: break-word; }
.found td:last-child { overflow-wrap: anywhere; }
.plain td:first-child, .plain td.text-right { white-space: nowrap !important; }
.q-table__card { background: transparent !important; }
.choice { min-width: 150px; }
.nothing { padding: 8px 4px; opacity: .7; }
.form { display: flex; gap: 8px; flex-wrap: wrap; align-items: center; width: 100%; }
@media (max-width: 900px) {
  .board { grid-template-columns: minmax(0, 1fr); }
  .board > .stack { display: contents; } .stack > :nth-child(2) { order: 1; } .stack > :nth-child(n + 3) { order: 2; }
  .figures { grid-template-columns: repeat(3, minmax(0, 1fr)); }
  .nicegui-content { padding: 8px; gap: 8px; }
  .flow svg text[style*="font-size: 10px"] { display: none; }
  .q-tab__icon { display: none; } .q-tab { padding: 0 7px; min-width: 0; } .q-tab__label { font-size: .8rem; }
  .bar .q-btn__content .block { display: none; } .bar { gap: 4px; padding: 2px 8px; flex-wrap: nowrap; }
  .bar .who { overflow: hidden; text-overflow: ellipsis; white-space: nowrap; min-width: 0; }
  .plain td, .plain th { padding: 4px 5px !important; } .plain th { white-space: normal !important; }
  .plain th:not(.sorted) .q-table__sort-icon { display: none; }
  .queries td, .operators td, .counters td, .found td { overflow-wrap: anywhere !important; min-width: 48px; }
  .queries td:first-child, .operators td:first-child { white-space: normal !important; min-width: 120px; }
  .found thead { display: none; } .found tr, .found td { display: block; width: 100%; height: auto !important; }
  .found td { border: 0 !important; padding: 1px 5px !important; } .found tr { padding: 5px 0; border-bottom: 1px solid #8884; }
  .instances :is(td, th):is(:nth-child(3), :nth-child(4), :nth-child(5)), .counters :is(td, th):nth-child(4) { display: none; }
  .entry { flex-wrap: wrap; } .entry .text { flex-basis: 70%; }
  .entry .side { margin-left: 14px; }
}
"""
