//! Suggestions for names that are spelt wrong.

/// ` (did you mean …?)` with the candidate of `known` that is nearest to `name` in Damerau–Levenshtein distance; empty if none
/// is near.
pub(crate) fn did_you_mean(name: &str, known: &[&str]) -> String {
    known
        .iter()
        .map(|candidate| (strsim::damerau_levenshtein(name, candidate), candidate))
        .min()
        .filter(|(distance, candidate)| *distance <= 1 + name.len().max(candidate.len()) / 3)
        .map_or(String::new(), |(_, candidate)| format!(" (did you mean `{candidate}`?)"))
}
