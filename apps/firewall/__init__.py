"""From alerts and archive history to decisions, with reasons.

Alert ──► policy (is it enough, and may it be blocked?) ──► ledger (ids, expiry, probation) ──► Decision
                                 ▲                              ▲
                      history (earlier offences)      drop counters, confirmations
"""
