//! A program in Rust.

use std::fmt::Write as _;

use super::program::{Arg, Array, Program, Statement, Values, expression, pick_sections, statement, wrap};

const LIBRARY: &str = include_str!("library.rs");

/// The text of the file.
pub fn write(program: &Program) -> String {
    let mut text = String::new();
    // Writing to a String cannot fail.
    let _ = write_to(&mut text, program);
    text
}

fn write_to(text: &mut String, program: &Program) -> std::fmt::Result {
    let recipe = program.recipe;
    let [height, width] = recipe.preprocessing.source;
    let bytes =
        program.buffers.iter().map(|(buffer, len)| len * if buffer.holds_bytes() { 1 } else { 4 }).sum::<usize>();
    writeln!(
        text,
        "// Recipe {}, written by steersman {}. One module, without `std` and without `unsafe`:\n\
         //\n//     mod model;\n//     static MODEL: Mutex<model::Model> = Mutex::new(model::Model::new());\n",
        recipe.name,
        env!("CARGO_PKG_VERSION")
    )?;
    writeln!(
        text,
        "/// Rows of the camera image.\npub const HEIGHT: usize = {height};\n\
         /// Pixels of a row.\npub const WIDTH: usize = {width};\n\
         /// Angle of the front wheels at steering 1, in degrees.\npub const FULL_LOCK_DEG: f32 = {:?};\n",
        recipe.full_lock_deg as f32
    )?;
    let outputs = &recipe.outputs;
    if outputs.count() > 1 {
        writeln!(text, "/// Number of outputs.\npub const OUTPUTS: usize = {};", outputs.count())?;
        for (place, output) in outputs.specs().iter().enumerate() {
            let (name, meaning) = (output.name.name().to_uppercase(), outputs.meaning(output.name));
            writeln!(text, "/// Place among the outputs: {meaning}.\npub const {name}: usize = {place};")?;
        }
        if let Some(mph) = outputs.top_speed_mph() {
            writeln!(
                text,
                "/// Speed at an output `speed` of 1, mph.\npub const TOP_SPEED_MPH: f32 = {:?};",
                mph as f32
            )?;
        }
        writeln!(text)?;
    }
    let declare = |(buffer, len): &(super::program::Buffer, usize)| {
        format!("    {}: [{}; {len}],\n", buffer.name(), if buffer.holds_bytes() { "u8" } else { "f32" })
    };
    let fields: String = program.buffers.iter().map(declare).collect();
    let zeros = program
        .buffers
        .iter()
        .map(|(buffer, len)| format!("{}: [{}; {len}]", buffer.name(), if buffer.holds_bytes() { "0" } else { "0.0" }));
    let zeros = zeros.collect::<Vec<_>>().join(", ");
    let names = program.buffers.iter().map(|(buffer, _)| buffer.name()).collect::<Vec<_>>().join(", ");
    writeln!(
        text,
        "/// The model with its buffers, {} KiB: one for each thread, in a `static` where the stack is small.\n\
         pub struct Model {{\n{fields}}}\n\n\
         impl Model {{\n    /// Empty buffers.\n    pub const fn new() -> Model {{\n        Model {{ {zeros} }}\n    }}\n",
        bytes.div_ceil(1024)
    )?;
    writeln!(
        text,
        "    /// The steering for a camera image in RGB, row by row: roughly in [-1, 1], positive to the right, not clamped;\n    \
         /// times [`FULL_LOCK_DEG`] it is degrees of the front wheels. An image of another size has to be scaled before.\n    \
         ///\n    \
         /// The caller must check that the camera's frame was decoded without an error, is complete and new, and that the\n    \
         /// result is finite, and clamp it to [-1, 1]. Without such a frame, hold the last good angle for at most 0.5 s, with\n    \
         /// the throttle off, and then brake.\n    \
         pub fn steer(&mut self, image: &[u8; HEIGHT * WIDTH * 3]) -> f32 {{"
    )?;
    if outputs.count() > 1 {
        writeln!(
            text,
            "        self.outputs(image)[STEERING]\n    }}\n\n    \
             /// All outputs for a camera image, as [`steer`](Model::steer) takes it; none is clamped.\n    \
             pub fn outputs(&mut self, image: &[u8; HEIGHT * WIDTH * 3]) -> [f32; OUTPUTS] {{"
        )?;
    }
    writeln!(text, "        let Model {{ {names} }} = self;")?;
    for step in &program.statements {
        match step {
            Statement::Call { comment, function, args } => {
                if let Some(comment) = comment {
                    writeln!(text, "        // {comment}")?;
                }
                let args: Vec<String> = args.iter().map(argument).collect();
                writeln!(text, "{}", statement(function, &args, "        "))?;
            }
            Statement::Map { comment, buffer, len, formula } => {
                let value = expression(formula, "*x", |value| format!("{value:?}"));
                writeln!(text, "        // {comment}\n        for x in &mut {}[..{len}] {{", buffer.name())?;
                writeln!(text, "            *x = {value};\n        }}")?;
            }
        }
    }
    let result = program.result.name();
    match outputs.count() {
        1 => writeln!(text, "        {result}[0]\n    }}\n}}\n")?,
        _ => writeln!(text, "        core::array::from_fn(|output| {result}[output])\n    }}\n}}\n")?,
    }
    writeln!(text, "impl Default for Model {{\n    fn default() -> Model {{\n        Model::new()\n    }}\n}}\n")?;
    for array in &program.tables {
        write_array(text, array)?;
    }
    for (name, value) in &program.constants {
        writeln!(text, "const {name}: i32 = {value};")?;
    }
    text.push_str(&pick_sections(LIBRARY, &program.sections));
    for array in &program.arrays {
        write_array(text, array)?;
    }
    text.truncate(text.trim_end().len());
    text.push('\n');
    Ok(())
}

fn write_array(text: &mut String, Array { name, values }: &Array) -> std::fmt::Result {
    let (kind, len, numbers) = match values {
        Values::F32(values) => ("f32", values.len(), wrap(values.iter().map(|value| format!("{value:?}")))),
        Values::I32(values) => ("i32", values.len(), wrap(values.iter().map(i32::to_string))),
        Values::U16(values) => ("u16", values.len(), wrap(values.iter().map(u16::to_string))),
    };
    // A weight may come close to a mathematical constant.
    let lint = if matches!(values, Values::F32(_)) { "#[allow(clippy::approx_constant)]\n" } else { "" };
    writeln!(text, "{lint}static {}: [{kind}; {len}] = [\n{numbers}\n];\n", name.to_uppercase())
}

fn argument(arg: &Arg) -> String {
    match arg {
        Arg::Image(range) => format!("&image[{}..{}]", range.start, range.end),
        Arg::Read(buffer, 0) => format!("&{}[..]", buffer.name()),
        Arg::Read(buffer, offset) => format!("&{}[{offset}..]", buffer.name()),
        Arg::Write(buffer, 0) => format!("&mut {}[..]", buffer.name()),
        Arg::Write(buffer, offset) => format!("&mut {}[{offset}..]", buffer.name()),
        Arg::Change(buffer, len) => format!("&mut {}[..{len}]", buffer.name()),
        Arg::Array(name) => format!("&{}", name.to_uppercase()),
        Arg::Int(value) => value.to_string(),
        Arg::Float(value) => format!("{value:?}"),
        Arg::Sizes(name, fields) => {
            let fields: Vec<_> = fields.iter().map(|(field, value)| format!("{field}: {value}")).collect();
            let (first, rest) = name.split_at(1);
            format!("{}{rest} {{ {} }}", first.to_uppercase(), fields.join(", "))
        }
        Arg::Function(name) => name.to_string(),
    }
}
