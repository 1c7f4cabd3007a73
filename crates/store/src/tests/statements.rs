//! Every statement of this crate fits the tables.

use std::collections::BTreeMap;
use std::path::Path;

use proc_macro2::{Delimiter, Group, TokenStream, TokenTree};
use sqlx::{AssertSqlSafe, Executor, SqlSafeStr};

use crate::{Purpose, Store};

/// Words with which a text begins that is a statement.
const VERBS: [&str; 6] = ["SELECT ", "INSERT ", "UPDATE ", "DELETE ", "WITH ", "PRAGMA "];

/// A rule of a `macro_rules!`: the names of its parameters, and the tokens that replace it.
struct Rule {
    parameters: Vec<String>,
    body: Vec<TokenTree>,
}

/// The statements of the sources, with the macros that compose them.
#[derive(Default)]
struct Statements {
    rules: BTreeMap<String, Vec<Rule>>,
    texts: Vec<String>,
}

fn tokens(stream: TokenStream) -> Vec<TokenTree> {
    stream.into_iter().collect()
}

fn group(tree: &TokenTree) -> Option<&Group> {
    if let TokenTree::Group(group) = tree { Some(group) } else { None }
}

fn is_mark(tree: &TokenTree, mark: char) -> bool {
    matches!(tree, TokenTree::Punct(found) if found.as_char() == mark)
}

/// The parts between commas.
fn split(stream: TokenStream) -> Vec<Vec<TokenTree>> {
    let trees = tokens(stream);
    let parts = trees.split(|tree| is_mark(tree, ',')).map(<[TokenTree]>::to_vec);
    parts.filter(|part| !part.is_empty()).collect()
}

/// The name, the arguments and the length of a macro call at the start of these tokens.
fn call(trees: &[TokenTree]) -> Option<(String, TokenStream, usize)> {
    let [TokenTree::Ident(name), mark, arguments, ..] = trees else { return None };
    let arguments = group(arguments)?;
    is_mark(mark, '!').then(|| (name.to_string(), arguments.stream(), 3))
}

impl Statements {
    /// Remembers the rules of `macro_rules! name { (...) => {...}; ... }`.
    fn learn(&mut self, trees: &[TokenTree]) {
        for (at, tree) in trees.iter().enumerate() {
            if let TokenTree::Ident(word) = tree
                && word == "macro_rules"
            {
                let (name, rules) = (trees[at + 2].to_string(), group(&trees[at + 3]).unwrap());
                let groups: Vec<_> =
                    tokens(rules.stream()).iter().filter_map(group).cloned().collect();
                let learned = groups.chunks_exact(2).map(|pair| {
                    let pattern = tokens(pair[0].stream());
                    let parameters = pattern.windows(2).filter(|pair| is_mark(&pair[0], '$'));
                    let parameters = parameters.map(|pair| pair[1].to_string()).collect();
                    Rule { parameters, body: tokens(pair[1].stream()) }
                });
                self.rules.insert(name, learned.collect());
            }
        }
    }

    /// The constant text that these tokens are, if they are one.
    fn text(&self, trees: &[TokenTree], values: &BTreeMap<String, String>) -> Option<String> {
        match trees {
            [TokenTree::Literal(literal)] => match syn::Lit::new(literal.clone()) {
                syn::Lit::Str(text) => Some(text.value()),
                _ => None,
            },
            [dollar, TokenTree::Ident(name)] if is_mark(dollar, '$') => {
                values.get(&name.to_string()).cloned()
            }
            _ => {
                // The path of a macro of another module precedes its name.
                let start =
                    trees.iter().rposition(|tree| is_mark(tree, ':')).map_or(0, |at| at + 1);
                let (name, arguments, length) = call(&trees[start..])?;
                if start + length != trees.len() {
                    return None;
                }
                let arguments = tokens(arguments);
                // An internal rule is marked with @.
                let own = arguments.first().is_some_and(|tree| is_mark(tree, '@'));
                let arguments: TokenStream = arguments.into_iter().skip(usize::from(own)).collect();
                let parts: Option<Vec<String>> =
                    split(arguments).iter().map(|part| self.text(part, values)).collect();
                let parts = parts?;
                if name == "concat" {
                    return Some(parts.concat());
                }
                let fits = |rule: &&Rule| rule.parameters.len() == parts.len();
                let rules = self.rules.get(&name)?;
                let rule = if own { rules.last() } else { rules.iter().find(fits) }?;
                let values = rule.parameters.iter().cloned().zip(parts).collect();
                self.text(&rule.body, &values)
            }
        }
    }

    /// Finds the statements among these tokens.
    fn find(&mut self, trees: &[TokenTree]) {
        let mut at = 0;
        while at < trees.len() {
            let rest = &trees[at..];
            match rest {
                [TokenTree::Ident(word), ..] if word == "macro_rules" => {
                    at += 4;
                    continue;
                }
                // Tests write other statements.
                [TokenTree::Ident(word), _, body, ..] if word == "mod" && group(body).is_some() => {
                    at += 3;
                    continue;
                }
                [TokenTree::Ident(word), _, ..] if word == "mod" => {}
                [tree @ TokenTree::Literal(_), ..] => self.keep(std::slice::from_ref(tree)),
                _ => {}
            }
            if let Some((_, arguments, length)) = call(rest) {
                if self.text(&rest[..length], &BTreeMap::new()).is_some() {
                    self.keep(&rest[..length]);
                } else {
                    self.find(&tokens(arguments));
                }
                at += length;
                continue;
            }
            if let Some(inner) = group(&trees[at]) {
                let attribute = at > 0 && is_mark(&trees[at - 1], '#');
                if !(attribute && inner.delimiter() == Delimiter::Bracket) {
                    self.find(&tokens(inner.stream()));
                }
            }
            at += 1;
        }
    }

    fn keep(&mut self, trees: &[TokenTree]) {
        let text = self.text(trees, &BTreeMap::new());
        self.texts.extend(text.filter(|text| VERBS.iter().any(|verb| text.starts_with(verb))));
    }
}

fn sources(folder: &Path, found: &mut Vec<String>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_stem().unwrap().to_string_lossy().into_owned();
        if name == "tests" {
            continue;
        }
        if path.is_dir() {
            sources(&path, found);
        } else {
            found.push(std::fs::read_to_string(&path).unwrap());
        }
    }
}

#[tokio::test]
async fn every_statement_fits_the_tables() {
    let mut files = Vec::new();
    sources(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src"), &mut files);
    let files: Vec<_> =
        files.iter().map(|text| tokens(text.parse::<TokenStream>().unwrap())).collect();
    let mut statements = Statements::default();
    files.iter().for_each(|trees| statements.learn(trees));
    files.iter().for_each(|trees| statements.find(trees));
    // Fewer would mean that the search misses some.
    assert!(statements.texts.len() > 180, "{}", statements.texts.len());
    let composed = ["FROM requests WHERE token = ?1", "WHERE state = 'ready' AND kind <> 'tile'"];
    for part in composed {
        assert!(statements.texts.iter().any(|text| text.contains(part)), "{part}");
    }
    let folder = tempfile::tempdir().unwrap();
    let purpose = Purpose::Serve { accept_database: false };
    let store = Store::open(folder.path(), purpose).await.unwrap();
    let mut connection = store.writer.acquire().await.unwrap();
    for text in statements.texts {
        let prepared = connection.prepare(AssertSqlSafe(text.clone()).into_sql_str()).await;
        assert!(prepared.is_ok(), "{text}: {}", prepared.err().unwrap());
    }
}
