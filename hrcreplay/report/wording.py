"""Fixed words of the page."""

from __future__ import annotations

#: Below each figure.
CAPTIONS = {
    "fig14_speed": (
        "As the paper's Fig. 14. Programmed speed of the TCP; its actual speed, braking shaded; and the smallest "
        "distance, surface to surface, between the robot and what the person could reach within the stopping time."
    ),
    "status": (
        "What the robot did over time. Limited: held by a safety constraint or a limit. Above each bar, in grey, when "
        "it was near the person; solid, when it then stood although its programme moves. Where stretches are narrower "
        "than a line, the gravest status is drawn."
    ),
    "stationary_share": (
        "Share of the ticks near the person at which the robot stood still although its programme moves. The hatched "
        "bars are the paper's own numbers, from its own data: they can be compared in kind only."
    ),
    "fig13_path": (
        "As the paper's Fig. 13. Programmed and actual path of the TCP, and the largest deviation between them with "
        "its length. Shaded: the swept volumes of the person at that tick. The paper's own deviation is 0.221 m."
    ),
    "robot_links": (
        "The robot as its distances see it: a capsule around each collision shape of its links, at the tick of the "
        "smallest separation, beside the swept volumes of the person. The square is the robot's base."
    ),
    "fig17_volumes": (
        "As the paper's Fig. 17. What the person could reach within the stopping time at four instants, limb radii "
        "included: from positions and velocities; by the older method, from positions alone; and as this run did it, "
        "where that is neither."
    ),
    "fig18_coordinate": (
        "As the paper's Fig. 18. One coordinate of the person as each camera saw it and as fused, and where the log "
        "has ground truth, the errors."
    ),
    "fusion_error": (
        "Root mean square error against ground truth, of each camera's raw angles and of the fused state."
    ),
    "joint_angles": (
        "All twelve joints of the human model: the cameras' raw values (dots) and the fused state (line)."
    ),
    "data_quality": (
        "When each camera's frames held the person (pale), when the filter used them (solid), and when it had none."
    ),
}

#: Rows of the comparisons: label, and suffix of the metrics' names.
PLAN_SAFETY = (
    ("ticks", "ticks"),
    ("tracking freely", "tracking_share"),
    ("limited", "limited_share"),
    ("braking", "braking_share"),
    ("ticks with the robot moving", "moving_ticks"),
    ("ticks braking with the robot still moving", "braking_moving_ticks"),
    ("ticks moving while touching a swept volume", "contact_moving_ticks"),
    ("smallest separation while moving", "separation_min_moving_m"),
    ("smallest separation at all", "separation_min_m"),
    ("\u2026 at", "separation_min_at_s"),
    ("\u2026 limb", "separation_min_limb"),
    ("\u2026 link", "separation_min_link"),
    ("ticks without a known separation", "separation_unknown_ticks"),
)
PLAN_COST = (
    ("stationary share of the near ticks", "stationary_share"),
    ("near ticks", "near_ticks"),
    ("stationary ticks", "stationary_ticks"),
    ("pace, of the programmed", "progress_share"),
    ("time lost", "time_lost_s"),
    ("cycles", "cycles"),
    ("path that the reference travelled", "ref_travelled_m"),
    ("deviation from the path, mean", "deviation_mean_m"),
    ("\u2026 95th percentile", "deviation_p95_m"),
    ("\u2026 largest", "deviation_max_m"),
    ("behind the reference, mean", "tracking_error_mean_m"),
    ("mean TCP speed", "tcp_speed_mean_m_per_s"),
    ("mean programmed speed", "ref_speed_mean_m_per_s"),
)
CAMERA = (
    ("frames with the person", "frames"),
    ("rate", "rate_hz"),
    ("gaps", "gaps"),
    ("longest gap", "gap_max_s"),
    ("ticks whose update used it", "valid_share"),
    ("time available", "available_share"),
)
FUSION = (
    ("angle RMSE, 10 angles pooled", "angle_rmse"),
    ("\u2026 while seen", "seen_angle_rmse"),
    ("angle error, median", "angle_median"),
    ("angular velocity RMSE, pooled", "velocity_rmse"),
    ("\u2026 while seen", "seen_velocity_rmse"),
    ("angular velocity error, median", "velocity_median"),
    ("RMSE of x", "rmse_x"),
    ("RMSE of y", "rmse_y"),
)

#: What happened at the ticks at which the robot braked, by the reason that its record gives (``stepping.REASONS``).
REASONS = {
    "no human state": "it was not known where the person is: no camera had shown them lately, or none yet",
    "no solution": "no motion satisfied all constraints",
    "separation failed": (
        "the distance from the robot to what the person could reach could not be computed as surely as the constraint "
        "needs it; where the person is was known"
    ),
    "not finite": "the robot's own state, its reference or the constraints held a number that is none",
}


def happened(reason: str) -> str:
    """What happened at a tick with a reason to brake; of a reason without words, the record's own."""
    return REASONS.get(reason, f"the record says '{reason}'")


#: The limits of what a page can say.
NOT_CLAIMED = (
    "hrcreplay is a research tool. It is not certified, and no page of it makes a robot cell safe or compliant.",
    (
        "Only ticks were checked, with the recorded person's actual motion as the log has it. A person who sees a "
        "robot move differently may move differently too."
    ),
    (
        "The swept volumes follow from a model of twelve joints and assumed bounds. Real people bend sideways, lift "
        "shoulders and move faster than Table 1: the method 'paper' does not enclose all that a person can do."
    ),
    (
        "The limb's radius is all the room there is for clothes, tools and the cameras' own errors, unless the "
        "settings add clearance."
    ),
    "The robot is assumed to follow its commands exactly and to brake within the stopping time.",
    "The paper's numbers come from experiments whose logs were never published. They are printed for orientation.",
)
