"""Checks the prose and the names of the repository against the style rules of CONTRIBUTING.md.

Usage:
    prose.py [PATH ...]                  list the findings below these paths (default: the repository)
    prose.py --rate [PATH ...]           one line: findings per 1,000 words
    prose.py --folders [PATH ...]        one line for each folder, the highest rate first
    prose.py --changed BASE [PATH ...]   only lines that were added or changed since the commit BASE
    prose.py --at-most RATE ...          exit with 1 if the rate is above RATE; combines with all of these
    prose.py --self-test                 check the tool against its examples

It reads comments, docstrings, Markdown, the descriptions of openapi.yaml, the text of HTML and Makefiles,
and string literals of three words or more: error messages, help texts, labels. A line with the word
`prose-check: off` is skipped.

A finding is a reminder, not a verdict: rewrite the sentence, don't swap the word.
"""

import argparse
import ast
import dataclasses
import pathlib
import re
import subprocess
import sys
import tokenize

# A sentence opening that leaves the reader without a subject, or inverts the sentence.
OPENINGS = re.compile(
    r"""(?x)^(?:
      Of \s (?:a|an|the|each|what|all|those|these|which|two|one|several|many|its|it|them|such|this|that)\b
    | (?:Whose|Whoever|Whatever|Wherein|Whereof)\b
    | (?:That|Those|Such) \s (?:of|as)\b | Those \s (?:that|which|who)\b | Such \s (?:a|an)\b .{0,40} [.]$
    | The \s same \s (?:of|as|for|in|to|from|with|by)\b | The \s same [.]$
    | What \s (?!to\s(?:do|try)\b) (?:is|was|are|were|it|they|he|we|a|an|the|to|one|of|each|all|had|has|have|could|can|would|no|may|must|comes|goes|fits|does|did|makes|others|another)\b(?![^.]*[?])
    | Who \s (?!CODE)\w+ \b(?![^.]*[?])
    | Whether\b
    | By \s (?:how|what|which|whom)\b
    | None \s (?:of|where|if|when|for|while|as)\b
    | (?:As|So) \s (?:it|they|he|long|planned|many|much|far|little|few)\b .{0,40} [.]$
    | (?:Its|Their|His) (?:\s [\w-]+){1,3} [.]$
    | Not \s (?:by|of|more|in|the|as|to|from|with|before|after|until)\b
    | (?:Less|More|Fewer) \s is\b
    | Nor\b | Else\s | Likewise\b | Meanwhile\b | Herewith\b
    | (?:Where|Which|How) \s (?!CODE)[\w ,'’-]+ [.]$
    )"""
)

# Wordings that are frequent in translated English and rare in the documentation of well-kept projects.
PHRASES = re.compile(
    r"""(?xi)\b(?:
      (?:is|are|was|were|be|been|being) \s told | tell(?:s|ing)? \s (?:of|from|what|which|how|whether|apart|who|it|nothing|him|them|us|on)\b
    | told \s (?:of|by|from|apart|to|what|in|there|here)
    | so \s (?:much|many) \s is | can(?:'t|’t|not)? \s be \s had | could(?:n't)? \s be \s had | to \s be \s had
    | the \s (?:less|more) ,? \s the \s (?:less|more) | (?:is|are) \s others \s than | of \s before | held \s to \s be
    | for \s want \s of | as \s need \s be | ha(?:s|ve|d) \s come \s to | come \s to \s nothing
    | by \s (?:itself|themselves) | of \s (?:its|their|his|one's|one’s) \s own | in \s the \s mean\b(?!\s(?:of|and|or)\b)
    | of \s (?:which|whom|what)\b | whose \s (?:what|which)
    | nobody['’]s | no \s one['’]s | one \s another['’]s | at \s rest\b | from \s nothing\b | likewise | meanwhile
    | is \s held \s by | (?:that|what|who|which) \s is \s none | what \s (?:follows|belongs|remains|is \s left|is \s (?:to|not|in|at|of|no)|they \s are|it \s is|there \s is|is \s there)\b
    | what \s (?:was|were|had|has|have) \s (?:\w+ \s){0,2}(?:\w+ed|made|sent|read|written|found|come|gone|done|said|shown|kept|lost|seen|been)\b
    | the \s way \s of | ha(?:s|ve|d) \s the \s form \s of | is \s meant\b | of \s all \s that | all \s that \s (?:there \s )?is
    | (?:him|her|them|those|people|one|anyone|somebody|someone|nobody|everybody|he) \s who(?:ever)?\b | who(?:ever)? \s (?:asks|reads|runs|looks|calls|comes|goes|waits|knows|sends|holds|wants|shares|has|takes|gives|writes|may|can)\b(?![^.]*[?])
    | as \s (?:it|they|he) \s (?:is|are|was|were|stands?|stood|comes?|came|goes)\b(?!\s\w+(?:ed|en)\b)
    | is \s (?:no|any) \s more | no \s more\b(?!\s than) | any \s more\b(?=[.,;:]|$) | nowise | hence \s | thereof | therein | thereby | wherein | hereby
    | the \s (?:like|likes) \s of | and \s the \s like | a \s second \s time | at \s (?:a|one) \s time \s only
    | has \s (?:to \s )?(?:say|said) \b | is \s said \s to | (?:does|do|did) \s well \s to | is \s of \s (?:no|some|much)
    | there \s (?:shall|need) | shall\b | need \s not\b | must \s needs | is \s but\b | all \s but\b
    | gone \s wrong | goes \s wrong(?=\s(?:with|at)) | on \s record | comes? \s to \s (?:nothing|an \s end|light)
    | (?:is|are|was|were) \s (?:gone|there|here|at \s it|away|of \s use|in \s vain|in \s doubt|to \s be \s (?:had|seen|found|read))\b(?![^.]*[?])
    | beside \s (?:the|a|it|ours|that|this|each|other|another|numpy|them|one)\b
    | more \s shortly | once \s more | anew\b | afresh\b | alike\b | apart \s from \s each | in \s vain | for \s (?:good|nothing)\b
    | look(?:s|ed|ing)? \s after | is \s let \s (?:in|out|through) | lets? \s (?:in|go) | bring(?:s|ing)? \s (?:along|nothing)
    | with \s it \s for | made \s (?:of|from) \s (?:it|them|what|nothing) | (?:is|are) \s made \s (?:of|by) \s (?:it|them)\b
    | (?:one|all|each|some|most|none|both|many|two|three|any) \s of \s (?:what|them \s that|those \s that)\b
    )"""
)

# Identifiers that name no thing and no action, where they are defined.
DEFINITION = re.compile(
    r"\b(?:fn|const|static|struct|enum|trait|mod|type|def|class|function|let(?:\s+mut)?|var)\s+([A-Za-z_]\w*)"
)
BAD_WORD = frozenset(
    "tell told tells said says stills stilled apart gone begun nobody whose whatever whoever nearby normed furthest likewise "
    "meanwhile anew afresh alike thereof wherein".split()
)
BAD_NAME = re.compile(r"^(?:of|what|whose|who|which|that|those|none|such)_\w+|^(?:LEAST|DOUBT|CHANCE|MOVES|NEAR|LEFT|near)$")
# Words in a name; a test name may be longer than others.
LONGEST_NAME, LONGEST_TEST_NAME = 7, 12
# Words in a sentence. CONTRIBUTING.md asks for 25; this leaves room for figures and identifiers.
LONGEST_SENTENCE = 38

# Characters of a program among which no comment, string or block starts.
PLAIN = re.compile(r"[^\n/\"'`{}r]*")
PROGRAM = {"rs": "c", "js": "c", "mjs": "c", "c": "c", "h": "c", "css": "c"}
HASH = {"sh", "toml", "py", "mk", "yml", "service", "conf", "Makefile", "Dockerfile"}
SKIPPED = re.compile(r"(\.lock$|package-lock\.json$|(^|/)(corpus|fixtures?|version-0\.1)/|^scripts/prose\.py$)")
OFF = "prose-check: off"


@dataclasses.dataclass
class Passage:
    """Lines that are read as one text: a paragraph, a list item, a table cell or a string literal."""

    lines: list  # pairs of line number and text
    string: bool = False

    def joined(self):
        """The text, and the position at which each line starts in it."""
        text, starts = "", []
        for number, line in self.lines:
            if text and not text.endswith(" "):
                text += " "
            starts.append((len(text), number))
            text += line
        return text, starts


# Markdown, which is also what a comment holds.


def paragraphs(lines, base=None):
    """Splits lines of Markdown with this indentation into passages; fenced and indented code is left out."""
    fence, current, code = None, [], False
    if base is None:
        base = min((len(line) - len(line.lstrip()) for _, line in lines if line.strip()), default=0)
    after_blank = True
    for number, line in lines:
        stripped = line.strip()
        deep = bool(stripped) and len(line) - len(line.lstrip()) >= base + 4
        code = deep and (after_blank or code) or (code and not stripped)
        after_blank = not stripped
        if code and fence is None and stripped:
            if current:
                yield Passage(current)
                current = []
            continue
        opener = re.match(r"(```+|~~~+)", stripped)
        if opener or fence:
            if current:
                yield Passage(current)
                current = []
            if fence is None:
                fence = opener[1]
            elif stripped.startswith(fence):
                fence = None
            continue
        item = re.match(r"\s*(?:[-*+]|\d+[.)])\s+|#+\s+|>\s?", line)
        entry = re.match(r"\s*[\w$'/.()\[\],=<>-]+ {2,}(?=\S)", line)  # of a table of options
        item = item or entry
        if not stripped or item or stripped.startswith("|") or OFF in line:
            if current:
                yield Passage(current)
                current = []
        if not stripped or OFF in line:
            continue
        if stripped.startswith("|"):
            if not re.fullmatch(r"[|:\s-]+", stripped):
                yield from (Passage([(number, plain(cell))]) for cell in stripped.strip("|").split("|"))
            continue
        current.append((number, plain(line[item.end() :] if item else line)))
    if current:
        yield Passage(current)


def plain(line):
    """The line without markup; code is one word."""
    line = re.sub(r"``.+?``|`[^`]*`", "CODE", line)
    line = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", line)
    line = re.sub(r"https?://\S+", "CODE", line)
    return re.sub(r"[*]{1,3}|<[^<>]*>", "", line).strip()


def comment_blocks(comments):
    """Joins comments on consecutive lines, given as (line, marker, text, whether code precedes it)."""
    block, before = [], None
    for number, marker, text, trailing in comments:
        if block and (trailing or before != (number - 1, marker)):
            yield from paragraphs(block)
            block = []
        block.append((number, text))
        before = (number, None if trailing else marker)
    yield from paragraphs(block)


# Programs.


def literal(number, text):
    """The passages of a string literal: none for what isn't prose."""
    text = re.sub(r"\$?\{[^{}]*\}|%[sd]\b", "X", text)
    code = re.search(
        r"\b(SELECT|INSERT|UPDATE|DELETE FROM|CREATE (TABLE|INDEX|UNIQUE)|ALTER TABLE|PRAGMA|WHERE|VALUES|FROM)\b"
        r"|</\w+>|=>|::|&&|\|\||\b(import|def|return|const|function|print)\b.*[(;=]|^\s*[#$.\[<{(/-]|;\s*$|==|--\w|\w\(",
        text,
    )
    words = re.findall(r"[A-Za-z’']{2,}", text)
    if code or len(words) < 3 or len(text.split()) < 3 or sum(map(len, words)) < 0.6 * len(text.strip()):
        return
    lines = [(number + i, line) for i, line in enumerate(text.split("\n"))]
    for passage in paragraphs(lines):
        passage.string = True
        yield passage


def program(source, ext):
    """Comments and string literals of a language with the comments of C."""
    comments, strings = [], []
    position, line, size = 0, 1, len(source)
    before = ""  # the last character that is neither a space nor a comment
    code_in_line = False
    templates = []  # depths of braces at which a template literal of JavaScript goes on
    depth = 0
    while position < size:
        char = source[position]
        two = source[position : position + 2]
        if char == "\n":
            line, code_in_line, position = line + 1, False, position + 1
        elif two == "//" and ext != "css":
            end = source.find("\n", position)
            end = size if end < 0 else end
            marker = re.match(r"//[/!]?", source[position:end])[0]
            comments.append((line, marker, source[position + len(marker) : end], code_in_line))
            position = end
        elif two == "/*":
            end = source.find("*/", position + 2)
            end = size if end < 0 else end
            body = source[position + 2 : end].split("\n")
            for index, text in enumerate(body):
                comments.append((line + index, f"block {position}", re.sub(r"^\s*\*+ ?", "", text) if index else text.lstrip("*! "), False))
            line += len(body) - 1
            position = end + 2
        elif ext == "rs" and (raw := re.compile(r'b?r(#*)"').match(source, position)) and not before_is_word(source, position):
            end = source.find('"' + raw[1], raw.end())
            end = size if end < 0 else end
            text = source[raw.end() : end]
            strings += literal(line, text)
            line += text.count("\n")
            position, before, code_in_line = end + 1 + len(raw[1]), '"', True
        elif char == '"' or (char == "'" and ext != "rs" and ext != "css"):
            end = closing(source, position + 1, char)
            text = source[position + 1 : end]
            if ext == "rs":
                text = re.sub(r"\\\n[ \t]*", lambda m: "\0", text)
                strings += continued(line, text)
            else:
                strings += literal(line, unescaped(text))
            line += source.count("\n", position, end)
            position, before, code_in_line = end + 1, '"', True
        elif char == "'":
            # A character or a lifetime.
            found = re.compile(r"'(?:\\.[^']*|[^'\\])'|'\w+").match(source, position)
            position, before, code_in_line = (found.end() if found else position + 1), "'", True
        elif ext in ("js", "mjs") and (char == "`" or (char == "}" and templates and templates[-1] == depth)):
            if char == "}":
                templates.pop()
            end, opens = template(source, position + 1)
            text = source[position + 1 : end]
            strings += literal(line, unescaped(text))
            line += text.count("\n")
            if opens:
                templates.append(depth)
            position, before, code_in_line = end + (2 if opens else 1), '"', True
        elif ext in ("js", "mjs") and char == "/" and (before in "(,=:[!&|?{};+\n" or source[:position].rstrip().endswith("return")):
            found = re.compile(r"/(?:\\.|\[(?:\\.|[^\]\n])*\]|[^/\\\n\[])+/\w*").match(source, position)
            position, before, code_in_line = (found.end() if found else position + 1), "/", True
        else:
            depth += {"{": 1, "}": -1}.get(char, 0)
            end = position + 1 if char in "{}" else PLAIN.match(source, position + 1).end()
            if run := source[position:end].rstrip():
                before, code_in_line = run[-1], True
            position = end
    yield from comment_blocks(comments)
    yield from strings


def before_is_word(source, position):
    return position > 0 and (source[position - 1].isalnum() or source[position - 1] == "_")


def closing(source, position, quote):
    """The position of the quote that ends a string."""
    while position < len(source) and source[position] != quote:
        position += 2 if source[position] == "\\" else 1
    return min(position, len(source))


def template(source, position):
    """Where a template literal ends or is interrupted by an expression, and which of the two."""
    while position < len(source) and source[position] != "`":
        if source.startswith("${", position):
            return position, True
        position += 2 if source[position] == "\\" else 1
    return min(position, len(source)), False


def unescaped(text):
    return re.sub(r"\\(.)", lambda m: {"n": " ", "t": " ", "r": ""}.get(m[1], m[1]), text)


def continued(number, text):
    """The passages of a Rust string literal with lines that end in a backslash."""
    offsets, joined = [], ""
    for index, part in enumerate(text.split("\0")):
        offsets.append((len(joined), number + index + joined.count("\n")))
        joined += part
    for passage in literal(number, unescaped(joined)):
        # The line of each part is approximate: escapes are shorter than they are written.
        text = " ".join(line for _, line in passage.lines)
        cuts = [start for start, _ in offsets] + [len(text)]
        passage.lines = [(line, text[start:end]) for (start, line), end in zip(offsets, cuts[1:]) if text[start:end]] or passage.lines
        yield passage


def node_indent(node):
    """Indentation of a docstring."""
    return node.body[0].col_offset


def python(source):
    comments, strings = [], []
    lines = iter(source.splitlines(keepends=True))
    try:
        for token in tokenize.generate_tokens(lambda: next(lines, "")):
            if token.type == tokenize.COMMENT and not token.string.startswith("#!"):
                number, column = token.start
                comments.append((number, "#", token.string.lstrip("#"), bool(token.line[:column].strip())))
        tree = ast.parse(source)
    except (SyntaxError, tokenize.TokenError):
        return
    documented = set()
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)) and ast.get_docstring(node, clean=False):
            value = node.body[0].value
            documented.add(id(value))
            text = value.value.split("\n")
            strings += paragraphs([(value.lineno + i, line) for i, line in enumerate(text)], base=node_indent(node))
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = []
            for value in node.values:
                constant = isinstance(value, ast.Constant)
                parts.append(str(value.value) if constant else "X")
                if constant:
                    documented.add(id(value))
            strings += literal(node.lineno, "".join(parts).replace("\n", " "))
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documented:
            strings += literal(node.lineno, node.value.replace("\n", " "))
    yield from comment_blocks(comments)
    yield from strings


# Other files.


def hash_comments(source, marker="#"):
    """Comments that start with a marker, at the start of a line or after a space."""
    pattern = re.compile(rf"(^|.*\s){re.escape(marker)}{re.escape(marker)}?\s(.*)$")
    comments = []
    for number, line in enumerate(source.split("\n"), 1):
        if line.startswith("#!"):
            continue
        if line.strip() == marker:
            comments.append((number, marker, "", False))
        elif match := re.match(rf"(\s*){re.escape(marker)}+ ?(.*)$", line):
            comments.append((number, marker, match[2], False))
        elif (match := pattern.match(line)) and match[1].count('"') % 2 == 0 and match[1].count("'") % 2 == 0:
            comments.append((number, marker, match[2], True))
    yield from comment_blocks(comments)


def contract(source):
    """Titles, summaries and descriptions of an OpenAPI file, also those in blocks, and its comments."""
    lines = source.split("\n")
    number = 0
    while number < len(lines):
        line = lines[number]
        number += 1
        match = re.match(r"(\s*)(?:- )?(?:description|summary|title):\s*(.*)$", line)
        if match and re.fullmatch(r"[|>][-+]?\s*", match[2]):
            indent, block = len(match[1]), []
            while number < len(lines) and (not lines[number].strip() or len(lines[number]) - len(lines[number].lstrip()) > indent):
                block.append((number + 1, lines[number].strip()))
                number += 1
            yield from paragraphs(block)
        elif match and match[2]:
            indent, block = len(match[1]), [(number, match[2].strip("'\""))]
            while number < len(lines) and lines[number].strip() and len(lines[number]) - len(lines[number].lstrip()) > indent:
                if re.match(r"\s*[\w$\"'/{-]+:(\s|$)", lines[number]):
                    break
                block.append((number + 1, lines[number].strip().rstrip("'\"")))
                number += 1
            yield from paragraphs(block)
        else:
            for match in re.finditer(r"\b(?:description|summary|title):\s+(\"[^\"]*\"|'[^']*'|[^,}]+)", line):
                yield from paragraphs([(number, match[1].strip("'\" "))])
    yield from hash_comments(source)


def html(source):
    for number, line in enumerate(source.split("\n"), 1):
        for text in re.findall(r">([^<>]+)<|(?:title|alt|placeholder|aria-label)=\"([^\"]+)\"", line):
            yield from paragraphs([(number, text[0] or text[1])])


def passages(path, source):
    """All prose of a file."""
    name = pathlib.PurePath(path)
    ext = name.suffix[1:] or name.name
    if ext == "md":
        return list(paragraphs(list(enumerate(source.split("\n"), 1))))
    if ext in PROGRAM:
        return list(program(source, ext))
    if ext == "py":
        return list(python(source))
    if name.name == "openapi.yaml":
        return list(contract(source))
    if ext in ("html", "svg"):
        return list(html(source))
    if ext == "sql":
        return list(hash_comments(source, "--"))
    if ext == "m":
        return list(hash_comments(source, "%"))
    if ext in HASH or ext == "yaml":
        return list(hash_comments(source))
    return None


# Findings.


def sentences(text):
    """Sentences with their positions."""
    start = 0
    for match in re.finditer(r"(?<=[.!?])[\"”')]*\s+(?=[A-Z`\"“(])|(?<=\w):\s+(?=[A-Z])", text):
        yield start, text[start : match.start()]
        start = match.end()
    yield start, text[start:]


def prose_findings(passage):
    """Triples of line, rule and text."""
    text, starts = passage.joined()

    def at(position):
        return max(number for start, number in starts if start <= position)

    for start, sentence in sentences(text):
        opening = sentence.lstrip("\"“'( ")
        if passage.string and opening[:1].islower() and not opening.startswith("what "):
            opening = ""
        if OPENINGS.match(opening[:1].upper() + opening[1:]):
            yield at(start), "opening", sentence
        elif match := PHRASES.search(sentence):
            yield at(start + match.start()), f"phrase “{match[0]}”", sentence
        elif len(re.findall(r"\w[\w.,’'-]*", sentence)) > LONGEST_SENTENCE and not passage.string:
            yield at(start), "long sentence", sentence


def name_findings(path, source):
    """Definitions with names that say too little or too much."""
    if pathlib.PurePath(path).suffix not in (".rs", ".js", ".mjs", ".py", ".c"):
        return
    test = False
    for number, line in enumerate(source.split("\n"), 1):
        if OFF in line or re.match(r"\s*(//|#(?!\[)|\*)", line):
            continue
        for match in DEFINITION.finditer(re.sub(r"//.*|\"(?:\\.|[^\"\\])*\"", "", line)):
            words = [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z0-9]+", match[1])]
            longest = LONGEST_TEST_NAME if test or match[1].startswith("test_") else LONGEST_NAME
            if BAD_WORD.intersection(words) or BAD_NAME.match(match[1]) or len(words) > longest:
                yield number, "name", match[0]
        if line.strip():
            test = bool(re.search(r"#\[(\w+::)?test\b", line)) or (test and line.lstrip().startswith("#["))


def check(path, source):
    """The findings of a file, and the number of words that were read."""
    found = passages(path, source)
    if found is None:
        return [], 0
    findings = [finding for passage in found for finding in prose_findings(passage)]
    findings += name_findings(path, source)
    return sorted(set(findings)), sum(len(line.split()) for passage in found for _, line in passage.lines)


# The repository.


def git(*arguments):
    return subprocess.run(["git", *arguments], capture_output=True, text=True, errors="replace", check=True).stdout


def listed(paths):
    """Tracked and new files below the paths."""
    names = git("ls-files", "--cached", "--others", "--exclude-standard", "--", *paths).split("\n")
    return sorted({name for name in names if name and not SKIPPED.search(name)})


def added(base):
    """Numbers of the lines added since a commit, by file; None for a new file, all of it."""
    files, path = {name: None for name in git("ls-files", "--others", "--exclude-standard").split("\n")}, None
    for line in git("diff", "--unified=0", "--no-color", base, "--").split("\n"):
        if line.startswith("+++ "):
            path = line[6:] if line.startswith("+++ b/") else None
        elif path and (match := re.match(r"@@ -\S+ \+(\d+)(?:,(\d+))? @@", line)):
            start, count = int(match[1]), int(match[2] or 1)
            files.setdefault(path, set()).update(range(start, start + count))
    return files


def folder(path):
    """The folder by which rates are reported."""
    parts = pathlib.PurePath(path).parts
    depth = 3 if parts[:2] == ("src", "http") else 2
    return "/".join(parts[: min(depth, len(parts) - 1)]) or "."


def per_thousand(findings, words):
    return 1000 * findings / max(words, 1)


def main():
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("paths", nargs="*", metavar="PATH")
    options.add_argument("--rate", action="store_true")
    options.add_argument("--folders", action="store_true")
    options.add_argument("--changed", metavar="BASE")
    options.add_argument("--at-most", metavar="RATE", type=float)
    options.add_argument("--self-test", action="store_true")
    asked = options.parse_args()
    if asked.self_test:
        sys.exit(self_test())
    only = added(asked.changed) if asked.changed else None
    count = words = 0
    rows = {}
    for path in listed(asked.paths):
        if only is not None and path not in only:
            continue
        try:
            source = pathlib.Path(path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError):
            continue
        findings, read = check(path, source)
        if only is not None and only[path] is not None:
            findings = [finding for finding in findings if finding[0] in only[path]]
        count, words = count + len(findings), words + read
        row = rows.setdefault(folder(path), [0, 0])
        row[0], row[1] = row[0] + len(findings), row[1] + read
        if not asked.rate and not asked.folders:
            for number, rule, text in findings:
                print(f"{path}:{number}: {rule}: {text[:160]}")
    if asked.folders:
        for name, (found, read) in sorted(rows.items(), key=lambda item: -per_thousand(*item[1])):
            print(f"{per_thousand(found, read):6.1f}  {found:5d} findings  {read:7d} words  {name}")
    rate = per_thousand(count, words)
    print(f"{count} findings in {words} words: {rate:.1f} per 1,000", file=sys.stdout if asked.rate else sys.stderr)
    if asked.at_most is not None and rate > asked.at_most:
        print(f"more than {asked.at_most} per 1,000: rewrite the sentences listed by scripts/prose.py", file=sys.stderr)
        sys.exit(1)


# Examples: file name, content, and the rules that must be found in it, in order.
EXAMPLES = [
    ("a.rs", "/// Its address.\nfn address() {}\n", ["opening"]),
    ("a.rs", "/// The address of the service.\nfn address() {}\n", []),
    ("a.rs", "// One thing is checked.\n// Whose check failed is on record.\n", ["opening"]),
    ("a.rs", "// The network and the\n// images, of\n// which one is kept.\n", ["phrase"]),
    ("a.rs", "let url = 1; // As it is.\n", ["opening"]),
    ("a.rs", "/// `told`: the name of a field.\n", []),
    ("a.rs", "/// ```\n/// whose what is told of\n/// ```\n", []),
    ("a.rs", 'fail("the upload \\\n      is told of the error");\n', ["phrase"]),
    ("a.rs", 'fail("offset does not match the {count} bytes received");\n', []),
    ("a.rs", 'query("SELECT * FROM jobs WHERE one of those is told of it");\n', []),
    ("a.rs", "fn told(a: u8) {}\n", ["name"]),
    ("a.rs", "let c = '\"'; // Whether it is.\nlet x: &'a str = \"\";\n", ["opening"]),
    ("a.rs", "#[test]\nfn what_does_not_fit_is_refused() {}\n", ["name"]),
    ("a.rs", "#[test]\nfn a_simulated_snapshot_is_reconstructed() {}\n", []),
    ("a.rs", "fn sum() {} // prose-check: off, whose sum it is\n", []),
    ("a.js", 'put(h("p", null, "Those that wait are told of it."));\n', ["opening"]),
    ("a.js", "say(`${count} frames, ${dark} of them are dark`);\n", []),
    ("a.js", "say(`The frames of which ${dark} are ${a ? `there` : ``} dark`);\n", ["phrase"]),
    ("a.js", "const quote = /[\"']/; // Whether it ends.\n", ["opening"]),
    ("a.js", "/** Asks for the scale.\n * Who asks is told of it.\n */\n", ["opening"]),
    ("a.py", '"""Runs a command.\n\nOf the outputs, one is kept.\n"""\n', ["opening"]),
    ("a.py", 'fail(f"{name} is told of {error} as need be")\n', ["phrase"]),
    ("a.md", "Of the tiles, 3 are done.\n\n    whose what is told of it\n", ["opening"]),
    ("a.py", '"""Runs it.\n\n    whose what is told of it\n"""\n', []),
    ("a.md", "| Name | Effect |\n| --- | --- |\n| a | Whether it is read |\n", ["opening"]),
    ("a.md", "Is what is left of it read?\n", ["phrase"]),
    ("a.md", " ".join(["word"] * (LONGEST_SENTENCE + 1)) + ".\n", ["long sentence"]),
    ("a.md", "Set the limit. The service then rejects larger uploads.\n", []),
    ("openapi.yaml", "  description: |\n    The limit of it.\n    What is above it is refused.\n  type: string\n", ["opening"]),
    ("openapi.yaml", "  x: { description: Whose file it is., type: string }\n", ["opening"]),
    ("Makefile", "test: ## all tests, of which one is slow\n", ["phrase"]),
    ("index.html", "<p>What is wrong is told there.</p>\n", ["opening"]),
    ("a.toml", 'name = "a # whose"\n# Whose name it is.\n', ["opening"]),
]


def self_test():
    failed = 0
    for path, source, expected in EXAMPLES:
        found = [rule.split(" “")[0] for _, rule, _ in check(path, source)[0]]
        if found != expected:
            failed += 1
            print(f"{path}: {source!r}: expected {expected}, found {found}", file=sys.stderr)
    print(f"{len(EXAMPLES) - failed} of {len(EXAMPLES)} examples are judged as expected")
    return 1 if failed else 0


if __name__ == "__main__":
    main()
