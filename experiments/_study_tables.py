"""Which tables of a study the documents show, and where."""

# the study's name, the document, the name there, a caption, and columns (none named: all)
TABLES = (
    (
        *("skill", "README.md", "study_small"),
        "Error up to the horizon, floor, and skill (1 at the floor, 0 of the default): mean "
        "[90 % interval over fabrics].",
        "configuration",
        *(f"{m}: {what}" for m in ("fling", "shaking") for what in ("error [mm]", "skill")),
    ),
    (
        *("skill", "docs/results.md", "study_small_skill"),
        "Error up to the horizon, floor and skill by configuration: mean [90 % interval].",
    ),
    (
        *("learned", "docs/results.md", "study_small_learned"),
        "Error over that of the middle of the prior: geometric mean [90 % interval of it "
        "alone], p of all together (Holm), fabrics.",
    ),
    (
        *("truths", "docs/results.md", "study_small_truths"),
        "Of every judged motion: horizon, and, mean up to there, its floor by cause.",
    ),
    (
        *("beyond_folding", "docs/results.md", "study_small_beyond_folding"),
        "Folding, from the horizon on: how much simulation and recording differ.",
    ),
    (
        *("chamfer_real_to_sim", "docs/results.md", "study_small_chamfer"),
        "Distance from the true surface to samples of the simulated one, whole motions.",
    ),
    (
        *("findings", "docs/results.md", "study_small_findings"),
        "Conclusions of the paper, tested here by the surface, and how many fabrics would tell.",
        *("conclusion", "comparison", "answer", "ratio", "90% interval"),
        *("p (Holm)", "fabrics needed"),
    ),
    (
        *("parameters_cloth", "docs/results.md", "study_small_parameters"),
        *("Stiffness along warp and weft.", "recording", "warp [N/m]", "weft [N/m]"),
    ),
)
