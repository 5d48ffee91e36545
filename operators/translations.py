"""The extension's words in other languages: Blender takes every label, tooltip and report from here where it has one.

Another language is another entry; what is missing stays English. Contexts: "*" for labels, "Operator" for buttons.
"""

import bpy

GERMAN = {
    ("Operator", "Import CT Scan"): "CT-Scan importieren",
    ("Operator", "Import Hair"): "Haar importieren",
    ("Operator", "Look at Scan"): "Scan ansehen",
    ("Operator", "Reconstruct Hair"): "Haar rekonstruieren",
    ("Operator", "Resume Job"): "Auftrag fortsetzen",
    ("Operator", "Load Result"): "Ergebnis laden",
    ("Operator", "Export Hair"): "Haar exportieren",
    ("Operator", "Render Picture"): "Bild rendern",
    ("Operator", "Render Turntable"): "Rundumansicht rendern",
    ("Operator", "Simulate Hair"): "Haar simulieren",
    ("Operator", "Remove Simulation"): "Simulation entfernen",
    ("Operator", "Trim Hair"): "Haar schneiden",
    ("Operator", "Regrow Hair"): "Haar nachwachsen lassen",
    ("Operator", "Measure Regions"): "Bereiche messen",
    ("Operator", "Mannequin Head"): "Puppenkopf",
    ("Operator", "Scalp from Selection"): "Kopfhaut aus Auswahl",
    ("Operator", "Paint Scalp"): "Kopfhaut malen",
    ("Operator", "Place by Hand"): "Von Hand setzen",
    ("*", "Head"): "Kopf",
    ("*", "Reconstruct"): "Rekonstruieren",
    ("*", "Result"): "Ergebnis",
    ("*", "Simulate"): "Simulieren",
    ("*", "Thresholds"): "Schwellwerte",
    ("*", "Guides"): "Leitsträhnen",
    ("*", "Hair colour"): "Haarfarbe",
    ("*", "No result in the scene"): "Kein Ergebnis in der Szene",
}
TRANSLATIONS = {"de_DE": GERMAN}


def register() -> None:
    bpy.app.translations.register(__package__, TRANSLATIONS)


def unregister() -> None:
    bpy.app.translations.unregister(__package__)
