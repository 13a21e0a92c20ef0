"""The public names, and where each is; `r2s/__init__.py` imports them at first use."""

from r2s.environment.air import Air, Fan
from r2s.environment.contact import Table
from r2s.environment.scene import Control, Scene, along_path
from r2s.estimation.cards import Card, Provenance
from r2s.estimation.cards import read as read_card
from r2s.estimation.cards import write as write_card
from r2s.estimation.estimate import Estimate, Nuisance
from r2s.estimation.judgement import sensitivity
from r2s.estimation.method import Budget, Method
from r2s.estimation.methods import METHODS
from r2s.estimation.problem import NuisancePrior, Problem
from r2s.laboratory.bending import Cantilever, Drape
from r2s.laboratory.files import read_tests
from r2s.laboratory.pull import Pull
from r2s.materials import presets
from r2s.materials.bending import BendingLaw, HingeBending, HingeLaw
from r2s.materials.fabric import Fabric, bending_length
from r2s.materials.membrane import MembraneLaw, OrthotropicMembrane, SpringMembrane
from r2s.materials.parameters import (
    InformedSpace,
    IsotropicSpace,
    OrthotropicSpace,
    ParameterSpace,
    Range,
    SofteningSpace,
    StiffeningSpace,
)
from r2s.materials.plate import OrthotropicPlate, PlateBending, PlateLaw
from r2s.materials.stiffening import StiffeningMembrane
from r2s.materials.tables import TableBending, TableMembrane
from r2s.mesh.files import MeshFile, read_mesh
from r2s.mesh.mesh import Mesh, rectangle
from r2s.metrics.prediction_error import distances
from r2s.recordings.manifest import read_recordings
from r2s.recordings.recording import Recording, RecordingInfo, SheetPlacement, make_recording
from r2s.recordings.recording import load as load_recording
from r2s.recordings.recording import save as save_recording
from r2s.scenarios.energy import EnergyBalance, clamp_force, energy_balance
from r2s.scenarios.resolution import explicit_cloth, mpm_cloth
from r2s.scenarios.scenario import Scenario, from_recording, rollout
from r2s.scenarios.standard import Experiment, fling, folding, lifting, shaking, stretching, wind
from r2s.scenarios.synthetic import record
from r2s.solvers.explicit.cloth import ExplicitCloth
from r2s.solvers.implicit.cloth import ImplicitCloth, ImplicitState
from r2s.solvers.mpm.sheet import MPMCloth
from r2s.solvers.results import Result
from r2s.solvers.simulate import Solution, Solver, predicted_memory, simulate

__all__ = [
    # what a fabric is
    "Fabric",
    "bending_length",
    "presets",
    "MembraneLaw",
    "OrthotropicMembrane",
    "StiffeningMembrane",
    "SpringMembrane",
    "TableMembrane",
    "BendingLaw",
    "HingeLaw",
    "HingeBending",
    "TableBending",
    "PlateLaw",
    "PlateBending",
    "OrthotropicPlate",
    # the sheet, and what it meets
    "Mesh",
    "rectangle",
    "read_mesh",
    "MeshFile",
    "Scene",
    "Control",
    "along_path",
    "Air",
    "Fan",
    "Table",
    # solvers and motions
    "Solver",
    "ImplicitCloth",
    "ImplicitState",
    "ExplicitCloth",
    "MPMCloth",
    "simulate",
    "Solution",
    "Result",
    "predicted_memory",
    # experiments
    "Scenario",
    "Experiment",
    "lifting",
    "wind",
    "stretching",
    "folding",
    "fling",
    "shaking",
    "rollout",
    "explicit_cloth",
    "mpm_cloth",
    "energy_balance",
    "EnergyBalance",
    "clamp_force",
    # recordings
    "Recording",
    "RecordingInfo",
    "SheetPlacement",
    "make_recording",
    "load_recording",
    "save_recording",
    "read_recordings",
    "from_recording",
    "record",
    "distances",
    # laboratory tests
    "Pull",
    "Cantilever",
    "Drape",
    "read_tests",
    # estimates
    "ParameterSpace",
    "OrthotropicSpace",
    "IsotropicSpace",
    "SofteningSpace",
    "StiffeningSpace",
    "InformedSpace",
    "Range",
    "METHODS",
    "Method",
    "Problem",
    "NuisancePrior",
    "Budget",
    "Estimate",
    "Nuisance",
    "sensitivity",
    "Card",
    "Provenance",
    "read_card",
    "write_card",
]
