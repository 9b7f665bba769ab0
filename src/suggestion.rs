//! What a misspelt name may have meant.

/// ` (did you mean …?)` with the nearest of `known`, or nothing if none is near.
pub(crate) fn did_you_mean(name: &str, known: &[&str]) -> String {
    known
        .iter()
        .map(|candidate| (strsim::damerau_levenshtein(name, candidate), candidate))
        .min()
        .filter(|(distance, candidate)| *distance <= 1 + name.len().max(candidate.len()) / 3)
        .map_or(String::new(), |(_, candidate)| format!(" (did you mean `{candidate}`?)"))
}
