//! What a misspelt name, or the name of another library, may have meant.

/// Names in Keras and PyTorch, without case and underscores, each with the one of recipes.
const ELSEWHERE: &[(&str, &str)] = &[
    // Runs and optimizers.
    ("lr", "learning_rate"),
    ("eta", "learning_rate"),
    ("baselr", "learning_rate"),
    ("batchsize", "batch"),
    ("nepochs", "epochs"),
    ("nbepoch", "epochs"),
    ("numepochs", "epochs"),
    ("maxepochs", "epochs"),
    ("eps", "epsilon"),
    ("weightdecay", "l2"),
    ("kernelregularizer", "l2"),
    ("decay", "decay_per_update"),
    ("patience", "patience_epochs"),
    ("mindelta", "min_delta"),
    ("clipnorm", "clip_gradient_norm"),
    ("maxnorm", "clip_gradient_norm"),
    ("validationsplit", "validation_share"),
    ("valsplit", "validation_share"),
    ("testsize", "validation_share"),
    ("steeringcorrection", "side_cameras"),
    ("correction", "side_cameras"),
    ("colorspace", "colour"),
    ("color", "colour"),
    ("criterion", "loss"),
    // Entries of layers.
    ("outchannels", "filters"),
    ("nbfilter", "filters"),
    ("kernelsize", "kernel"),
    ("strides", "stride"),
    ("subsample", "stride"),
    ("bordermode", "padding"),
    ("poolsize", "window"),
    ("outfeatures", "units"),
    ("outputdim", "units"),
    ("rate", "drop_probability"),
    ("p", "drop_probability"),
    ("negativeslope", "slope"),
    ("kernelinitializer", "init"),
    // Kinds of layers, losses and optimizers.
    ("convolution2d", "conv2d"),
    ("linear", "dense"),
    ("fullyconnected", "dense"),
    ("maxpooling2d", "max_pool"),
    ("maxpool2d", "max_pool"),
    ("averagepooling2d", "average_pool"),
    ("avgpool2d", "average_pool"),
    ("batchnormalization", "batch_norm"),
    ("batchnorm2d", "batch_norm"),
    ("silu", "swish"),
    ("cropping2d", "crop"),
    ("zeropadding2d", "zero_pad"),
    ("zeropad2d", "zero_pad"),
    ("lambda", "scale"),
    ("rescaling", "scale"),
    ("mse", "mean_squared_error"),
    ("mseloss", "mean_squared_error"),
    ("smoothl1loss", "huber"),
    ("adamw", "adam"),
];

/// ` (did you mean …?)` with the one of `known` that is [`meant`] by `name`; nothing if none is near.
pub(crate) fn did_you_mean(name: &str, known: &[&str]) -> String {
    meant(name, known).map_or(String::new(), |meant| format!(" (did you mean `{meant}`?)"))
}

/// The one of `known` that other libraries call `name`, or else the nearest.
pub(crate) fn meant<'a>(name: &str, known: &[&'a str]) -> Option<&'a str> {
    let elsewhere = named_elsewhere(name).and_then(|meant| known.iter().find(|known| **known == meant).copied());
    elsewhere.or_else(|| {
        let near = |candidate: &&'a str| (strsim::damerau_levenshtein(name, candidate), *candidate);
        let (distance, candidate) = known.iter().map(near).min()?;
        (distance <= 1 + name.len().max(candidate.len()) / 3).then_some(candidate)
    })
}

/// What recipes call what Keras or PyTorch call `name`.
pub(crate) fn named_elsewhere(name: &str) -> Option<&'static str> {
    let plain: String = name.chars().filter(|c| !matches!(c, '_' | '-')).collect::<String>().to_lowercase();
    ELSEWHERE.iter().find(|(elsewhere, _)| *elsewhere == plain).map(|(_, ours)| *ours)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_other_libraries_go_before_near_ones() {
        // `l2` is nearer to `lr`.
        assert_eq!(did_you_mean("lr", &["l2", "learning_rate"]), " (did you mean `learning_rate`?)");
        assert_eq!(did_you_mean("MaxPooling2D", &["conv2d", "max_pool"]), " (did you mean `max_pool`?)");
        assert_eq!(did_you_mean("filtres", &["filters", "kernel"]), " (did you mean `filters`?)");
        assert_eq!(did_you_mean("lr", &["epochs"]), "");
    }
}
