#!/usr/bin/env python3
"""Count patterns of sentences that make a reader stop: docs, docstrings, comments, messages, C.

    python tools/plain.py              table: pattern x kind of text
    python tools/plain.py --show A4    the hits of one pattern, file:line and sentence
    python tools/plain.py --under starcat/catalog   only there

A hit is a place to look, not a verdict: a third of them are fine. CONTRIBUTING.md has the rule.
"""

import argparse
import ast
import collections
import pathlib
import re
import subprocess

NOUNS = "star row frame field file line pixel block record pair centroid step product band bin column job release test area level million second minute machine value number shift call catalog triangle year module function cell key tile side degree user process token night image region request piece table query run kind task page word axis camera month day hour map"
NOUN = "(?:" + "|".join(NOUNS.split()) + ")"
VERBS = "is are was were has have had would can will does do comes came only each takes makes made says wants lacks lies stands differs runs holds knows asks belongs goes went flew depends fails signs reads counts matters follows remains needs others".split()
PATTERNS = {
    "A1 'what ...' or 'who ...' in place of a noun": r"(?:^|[:;.(] |, (?:and )?|\b(?:of|with|by|for|from|beside|behind|than|say|says|as|but|and) )(?:[Ww]hat|[Ww]ho) (?:"
    + "|".join(VERBS)
    + r")\b",
    "A2 'that of', 'those that', 'is one' in place of the noun": r"\b(?:that of (?!a )|those of|those that|those (?:in|with|from|by|without|before)|the same (?:of|with|by|once)|the one (?:that|of|before|in)|the others? (?:of|that)|another one|is one\b|are such\b|are those)\b",
    "A3 comment or cell without a head": None,
    "A4 'a row a star' for 'per'": r"\b(?:one|each|a|an|\d[\d.,]*) (?:\w+ )?(?:row|line|file|text|column|array|step|block|star|frame|value|number|entry|part|point|cell|us|ms|px|bytes|module|function|task|second|answer)s? an? "
    + NOUN
    + r"\b",
    "A5 'is no file', 'that is none'": r"\b(?:is|are|was|were|be) no (?!longer|more|less|wider|fewer|larger|later|such|need|way|further|one|reason|doubt|other|place|room|answer)\w+|\b(?:that|which|it|and|one|this) (?:is|are|has|have) none\b",
    "A6 things that tell, say, want, know": r"\b(?:tells|tell|told|wants|wanted|believes?|speaks?|forgets?|remembers?|is asked|are asked|is said|says (?!that )|said of|knows)\b",
    "A7 'where' for 'if'": r"(?:[ ,;(]where (?:a|an|it|its|there|that|they|no|one|none|nothing|all|each|both|only|nobody|some|several|neither|needed|possible|known|stated|given)\b|^Where (?!is|are|the \w+ goes))",
    "A8 idiom that nobody says": r"\b(?:anew|be it|be they|for want of|but for|whoever|however many|foretell|thereabouts|nobody|somebody|sees? to it|so many|in vain|at the most|at the least|comes? to nothing|what becomes of|all the same|one after the other|told apart|to be had|as well as nothing)\b",
    "A9 private term": r"\b(?:rooms?|house|mends?|mended|mending|unsound|rivals?|lessons?|strays|hard nights|the ways|ledger|clerk|watcher)\b",
    "A10 two colons or semicolons in a sentence": None,
    "A11 more than 40 words": None,
}


def sentences(text):
    text = re.sub(r"\s+", " ", text).strip()
    return [s for s in re.split(r"(?<=[.!?:])\s+(?=[A-Z`*\[(])", text) if len(s.split()) >= 3]


def markdown(path):
    fence, lines, first = False, [], 1
    for i, line in enumerate([*path.read_text().split("\n"), ""], 1):
        if line.strip().startswith(("```", "$$")):
            fence = not fence
        if fence or line.startswith(("|", "#", "<!", "![", "```")) or not line.strip():
            yield from (("docs", first, s) for s in sentences(" ".join(lines)))
            lines = []
            if line.startswith("|") and not fence:
                yield from (
                    ("cells", i, c.strip())
                    for c in line.strip("|").split("|")
                    if len(c.split()) >= 5
                )
            continue
        if re.match(r"\s*([-*]|\d+\.)\s", line):
            yield from (("docs", first, s) for s in sentences(" ".join(lines)))
            lines = []
        if not lines:
            first = i
        lines.append(re.sub(r"^\s*([-*]|\d+\.)\s", "", line).strip())


COMMENT_OR_STRING = re.compile(
    r"#[^\n]*"
    r"|(\"{3}|'{3})(?s:\\.|.)*?\1"
    r"|([\"'])(?:\\.|(?!\2)[^\\\n])*\2"
)


def is_text(node):
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def python(path):
    text = path.read_text()
    seen = set()
    for node in ast.walk(ast.parse(text)):  # a node comes before its parts
        body = getattr(node, "body", None)
        for one in body if isinstance(body, list) else []:
            if isinstance(one, ast.Expr) and is_text(one.value):
                seen.add(id(one.value))
                yield from (("docstrings", one.lineno, s) for s in sentences(one.value.value))
        if isinstance(node, ast.JoinedStr):
            seen.update(map(id, node.values))
            parts = [v.value if isinstance(v, ast.Constant) else "..." for v in node.values]
            said = "".join(parts)
        elif is_text(node) and id(node) not in seen and len(node.value.split()) >= 5:
            said = node.value
        else:
            continue
        yield from (("strings", node.lineno, s) for s in sentences(said) if len(s.split()) >= 5)
    for match in COMMENT_OR_STRING.finditer(text):
        if match[0].startswith("#") and len(match[0].split()) >= 4:
            line = text.count("\n", 0, match.start()) + 1
            yield "comments", line, match[0].lstrip("# ").strip()


def c_code(path):
    text = path.read_text(errors="replace")
    for match in re.finditer(r"/\*(.*?)\*/", text, flags=re.S):
        line = text.count("\n", 0, match.start()) + 1
        yield from (("C", line, s) for s in sentences(re.sub(r"\n\s*\*", " ", match.group(1))))


def is_hit(name, pattern, kind, sentence):
    if name.startswith("A10"):
        return kind in ("docs", "docstrings", "C") and len(re.findall(r"[;:](?=\s)", sentence)) >= 2
    if name.startswith("A11"):
        return len(sentence.split()) > 40
    if name.startswith("A3"):
        return kind in ("comments", "cells", "C") and bool(
            re.match(
                r"(?:of|by|with|from|in|that|where|without|beyond|as|to|how|whether|which|what|than|on|at) ",
                sentence,
            )
        )
    return bool(re.search(pattern, sentence))


def find_hits(under="."):
    """Return the number of sentences of each kind of text, and the hits of each pattern."""
    listed = subprocess.run(["git", "ls-files", under], capture_output=True, text=True, check=True)
    readers = {
        ".md": markdown, ".py": python, ".c": c_code, ".h": c_code, ".cpp": c_code, ".hpp": c_code
    }  # fmt: skip
    total, hits = collections.Counter(), {label: [] for label in PATTERNS}
    for name in listed.stdout.split("\n"):
        path = pathlib.Path(name)
        if path.suffix not in readers or not path.is_file() or path.name == "plain.py":
            continue
        for kind, line, sentence in readers[path.suffix](path):
            kind = "tests" if "tests/" in name else kind
            total[kind] += 1
            for label, pattern in PATTERNS.items():
                if is_hit(label, pattern, kind, sentence):
                    hits[label].append((kind, f"{name}:{line}", sentence))
    return total, hits


def main():
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--show")
    options.add_argument("--under", default=".")
    options.add_argument("--most", type=int, default=60)
    asked = options.parse_args()
    total, hits = find_hits(asked.under)
    if asked.show:
        for label in (label for label in PATTERNS if label.startswith(asked.show + " ")):
            print(f"{label}: {len(hits[label])} hits")
            for kind, where, sentence in hits[label][: asked.most]:
                print(f"  {where} ({kind})\n      {sentence[:240]}")
        return
    kinds = ["docs", "cells", "docstrings", "comments", "strings", "C", "tests"]
    print(f"{'':58}" + "".join(f"{kind[:9]:>11}" for kind in kinds) + f"{'all':>8}")
    for label, count in [("sentences", total)] + [
        (label, collections.Counter(kind for kind, *_ in found)) for label, found in hits.items()
    ]:
        row = "".join(f"{count[kind]:11,}" for kind in kinds)
        print(f"{label[:57]:58}{row}{sum(count.values()):8,}")
    print(f"{'A1 to A9':58}{hits_of_a1_to_a9(hits):85,}")


def hits_of_a1_to_a9(hits):
    """Return the number of hits of the patterns that say how a sentence is written."""
    return sum(len(hits[p]) for p in PATTERNS if p.split()[0] not in ("A10", "A11"))


if __name__ == "__main__":
    main()
