"""The paper's four control laws, and two published ways to detumble: TVLQR about the plan, torque
against H.
"""
