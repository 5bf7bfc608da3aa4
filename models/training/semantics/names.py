"""Plain English nouns for the named meshes of `assets3d/index.json`.

The sources name their files for their own use ("bottle ketchup", "bed_double_A", "plate deep").
`plain_name(entry)` gives what a person would type ("ketchup bottle", "bed", "plate"). Training and
evaluation import this one function, so that both speak of the same words; nothing of it ships.

    python names.py --data ../../../../shared/data      # prints every name and what became of it
"""
import argparse
import json
import os
import re
import tarfile

# Words that say size, variant or state and leave the noun what it is.
DROP = set(
    "large small medium big decorated dirty basic detailed long short 1 2 a b c d low poly sci fi "
    "dinner raw cooked uncooked trash open flat chopped wood fancy standing double single kit "
    "birthday speciaal innercorner outercorner backsplash straight corner half rectangle oval deep "
    "broken multi countertop dark japanese luxury plastic crushed future rectangle future dark e".split()
)
# Names where dropping words is not enough: the source's own name to the plain one.
SAY = {
    "apple half": "apple", "avocado half": "avocado", "bacon raw": "bacon", "bag flat": "paper bag", "bag": "paper bag",
    "board": "cutting board", "cooking bench": "gas stove", "fitness equipment": "exercise bike",
    "kitchen utensils": "kitchen utensils", "tableware set": "tableware", "tvcabinet": "television cabinet",
    "portrait e": "picture frame", "trash can": "trash can", "basin": "sink", "bottle of barbecue sauce": "sauce bottle",
    "black book": "book", "yellow book": "book", "book single": "book", "book set": "books", "box of butter": "butter",
    "ramekin bowl": "bowl", "two layer wooden shelf": "shelf", "wooden shelf": "shelf", "black marker": "marker pen",
    "blue marker": "marker pen", "red marker": "marker pen", "large marker": "marker pen", "small marker": "marker pen",
    "blue cup": "cup", "green cup": "cup", "orange cup": "cup", "yellow cup": "cup", "conditioner": "conditioner bottle",
    "shampoo": "shampoo bottle", "glue": "glue bottle", "repellent": "spray bottle", "doraemon bowl": "bowl",
    "flat screwdriver": "screwdriver", "phillips screwdriver": "screwdriver", "large clamp": "clamp",
    "medium clamp": "clamp", "small clamp": "clamp", "mini claw hammer": "hammer", "orion pie": "biscuit box",
    "poker": "box of playing cards", "remote controller": "remote control", "sugar": "sugar box",
    "toothpaste": "toothpaste", "correction fluid": "correction fluid", "blaster": "toy gun", "boat large": "boat",
    "boat small": "boat", "bottle ketchup": "ketchup bottle", "ketchup": "ketchup bottle", "bottle mustard": "mustard bottle",
    "mustard": "mustard bottle", "bottle oil": "oil bottle", "bowl broth": "bowl of soup", "bowl soup": "bowl of soup",
    "bowl cereal": "bowl of cereal", "stew bowl": "bowl of stew", "stew": "bowl of stew", "bunny": "rabbit",
    "burger cheese double": "hamburger", "burger cheese": "hamburger", "burger double": "hamburger", "burger": "hamburger",
    "vegetableburger": "hamburger", "vegetableburger cooked": "burger patty", "vegetableburger uncooked": "burger patty",
    "burger cooked": "burger patty", "burger uncooked": "burger patty", "burger trash": "burger patty",
    "meat patty": "burger patty", "bun": "bread roll", "bun bottom": "bread roll", "bun top": "bread roll",
    "cake birthday": "birthday cake", "can": "tin can", "can open": "tin can", "can small": "tin can",
    "candy bar wrapper": "candy bar", "cannon ball": "cannonball", "cannon mobile": "cannon", "carton": "milk carton",
    "carton small": "milk carton", "celery stick": "celery", "cheese cut": "cheese", "cheese slice": "cheese",
    "chest": "treasure chest", "chinese": "takeout box", "chocolate": "chocolate bar", "chocolate wrapper": "chocolate bar",
    "chopstick": "chopsticks", "chopstick fancy": "chopsticks", "coconut half": "coconut", "cookie chocolate": "cookie",
    "cooking fork": "fork", "cooking knife": "knife", "cooking knife chopping": "knife", "cooking spatula": "spatula",
    "cooking spoon": "spoon", "cup saucer": "saucer", "cup tea": "teacup", "expresso cup": "espresso cup",
    "cutting board round": "cutting board", "cyborg female": "woman", "dim sum": "dumpling", "dog toy": "dog",
    "donut chocolate": "donut", "donut sprinkles": "donut", "egg cooked": "fried egg", "egg half": "egg",
    "firetruck": "fire truck", "fish bones": "fish bone", "frappe": "milkshake", "fries": "french fries",
    "fries empty": "french fries box", "frikandel speciaal": "sausage", "frying pan lid": "pan lid",
    "ginger bread": "gingerbread man", "ginger bread cutter": "cookie cutter", "glass": "drinking glass",
    "glass wine": "wine glass", "hatchback": "car", "sedan": "car", "sports sedan": "car", "suv": "car", "suv luxury": "car",
    "race car": "race car", "race future": "race car", "honey": "honey jar", "hot dog raw": "hot dog",
    "ice cream cone": "ice cream cone", "ice cream scoop mint": "ice cream scoop", "lemon half": "lemon",
    "library large": "building", "bread loaf": "loaf of bread", "bread loaf baguette": "baguette",
    "bread loaf round": "loaf of bread", "lollypop": "lollipop", "low poly horse": "horse", "low poly tree": "tree",
    "tree big": "tree", "tree small": "tree", "maki roe": "sushi", "maki salmon": "sushi", "maki vegetable": "sushi",
    "sushi egg": "sushi", "sushi roll": "sushi", "sushi salmon": "sushi", "meat cooked": "steak", "meat raw": "steak",
    "meat ribs": "ribs", "meat sausage": "sausage", "steak pieces": "steak", "sausage half": "sausage",
    "mechanical keyboard tenkeyless": "keyboard", "mincemeat pie": "pie", "mortar pestle": "pestle",
    "mug": "coffee mug", "mushroom half": "mushroom", "mussel open": "mussel", "onion half": "onion",
    "palm detailed long": "palm tree", "palm detailed short": "palm tree", "palm long": "palm tree", "palm short": "palm tree",
    "pan stew": "pan of stew", "bell pepper slice": "bell pepper", "peanut butter": "peanut butter jar",
    "pear half": "pear", "pepper": "chili pepper", "pirate captain": "pirate", "pirate crew": "pirate",
    "pirate officer": "pirate", "plant": "potted plant", "plant pirate kit": "plant", "plate sauerkraut": "plate of food",
    "plate dinner": "plate of food", "dinner": "plate of food", "styrofoam dinner": "food container",
    "styrofoam": "food container", "popsicle stick": "popsicle stick", "pot stew": "pot of stew", "stew pot": "pot of stew",
    "pot stew lid": "pot lid", "present": "gift box", "pumpkin basic": "pumpkin", "radish": "radish",
    "sci fi crate": "crate", "crate lid": "lid", "shaker pepper": "pepper shaker", "shaker salt": "salt shaker",
    "ship wreck": "shipwreck", "skater female": "woman", "skater man": "man", "survivor female": "woman",
    "survivor man": "man", "skewer vegetables": "skewer", "soda": "soda cup", "soda glass": "glass of soda",
    "soy": "soy sauce dish", "spilling coffee": "coffee cup", "sub": "sandwich", "sword scimitar": "sword",
    "tajine lid": "tagine lid", "tajine": "tagine", "tomato slice": "tomato", "tomato slices": "tomato",
    "tractor police": "tractor", "truck flat": "truck", "turkey": "roast turkey", "utensil fork": "fork",
    "utensil knife": "knife", "utensil spoon": "spoon", "whole ham": "ham", "wholer ham": "ham", "ham trash": "ham",
    "wine red": "wine bottle", "wine white": "wine bottle", "armchair pillows": "armchair", "couch": "sofa",
    "sofa pillows": "sofa", "cabinet medium decorated": "cabinet", "cactus medium": "cactus", "cactus small": "cactus",
    "chair stool": "stool", "chair stool wood": "stool", "lamp standing": "floor lamp", "lamp table": "table lamp",
    "rug oval": "rug", "rug rectangle": "rug", "rug rectangle stripes": "rug", "carpet": "rug",
    "table low": "coffee table", "table medium long": "table", "table round decorated": "round table",
    "table round": "round table", "table round small": "round table", "table round small decorated": "round table",
    "crate buns": "crate of bread rolls", "crate carrots": "crate of carrots", "crate cheese": "crate of cheese",
    "crate ham": "crate of ham", "crate lettuce": "crate of lettuce", "crate onions": "crate of onions",
    "crate potatoes": "crate of potatoes", "crate steak": "crate of steaks", "crate tomatoes": "crate of tomatoes",
    "dish rack plates": "dish rack", "carrot pieces": "carrot", "lettuce slice": "lettuce", "onion rings": "onion rings",
    "potato mashed": "mashed potato", "extractor hood": "range hood", "kitchen counter sink": "kitchen sink",
    "kitchen counter sink backsplash": "kitchen sink", "kitchen table sink": "kitchen sink",
    "kitchen table sink large": "kitchen sink", "kitchen table sink large decorated": "kitchen sink",
    "pan": "frying pan", "shelf paper towel": "shelf", "shelf paper towel decorated": "shelf", "fridge": "refrigerator",
    "stove single": "stove", "lid": "pot lid", "palm": "palm tree", "donut": "donut", "bed double": "bed",
    "zombie": "zombie", "man": "man", "boat": "boat", "tree": "tree", "dish drainer": "dish rack",
    "book holder": "book stand", "sword": "sword", "pizza cutter": "pizza cutter", "night stand": "nightstand",
}


def plain_name(entry) -> str:
    """The noun of one entry of `index.json`, lower case, one or a few plain words."""
    raw = re.sub(r"\s+", " ", entry["name"].lower().replace("_", " ").replace("-", " ")).strip()
    if raw in SAY:
        return SAY[raw]
    words = [w for w in raw.split() if w not in DROP]
    kept = " ".join(words) or raw
    return SAY.get(kept, kept)


def read_index(data):
    """The entries of `assets3d.tar`'s index in the folder of shared data."""
    with tarfile.open(os.path.join(data, "assets3d", "assets3d.tar")) as tar:
        return json.load(tar.extractfile("index.json"))


if __name__ == "__main__":
    ap = argparse.ArgumentParser()
    ap.add_argument("--data", required=True)
    for item in read_index(ap.parse_args().data):
        print(f"{item['file']:60} {item['name']:40} {plain_name(item)}")
