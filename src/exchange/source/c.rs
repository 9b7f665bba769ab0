//! A program in C99.

use std::fmt::Write as _;

use super::program::{Arg, Array, Buffer, Program, Statement, Values, expression, pick_sections, statement, wrap};
use crate::dataset::OutputKind;

const LIBRARY: &str = include_str!("library.c");
const IMAGE: &str = "const uint8_t image[STEER_HEIGHT * STEER_WIDTH * 3]";

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
    let kib = program.buffers.iter().map(|(buffer, len)| len * if buffer.holds_bytes() { 1 } else { 4 }).sum::<usize>();
    writeln!(
        text,
        "/*\n * Recipe {}, written by steersman {}. C99, needs no library.\n *\n * \
         steer(image) gives the steering for a camera image: roughly in [-1, 1], positive to the right, not clamped; times\n * \
         STEER_FULL_LOCK_DEG it is degrees of the front wheels. The image is {height} rows of {width} pixels, each red, green, \
         blue.\n * \
         An image of another size has to be scaled to that before. The buffers below are {} KiB, so only one thread\n * \
         at a time may call it; nothing is allocated.\n *\n * \
         The caller must check that the camera's frame was decoded without an error, is complete and new, and that the\n * \
         result is finite (x == x and fabsf(x) < INFINITY), and clamp it to [-1, 1]. Without such a frame, hold the last\n * \
         good angle for at most 0.5 s, with the throttle off, and then brake.\n */",
        recipe.name,
        env!("CARGO_PKG_VERSION"),
        kib.div_ceil(1024)
    )?;
    writeln!(text, "#include <stdint.h>\n")?;
    writeln!(text, "#define STEER_HEIGHT {height}\n#define STEER_WIDTH {width}")?;
    writeln!(text, "#define STEER_FULL_LOCK_DEG {:?}\n", recipe.full_lock_deg)?;
    let outputs = &recipe.outputs;
    if outputs.count() > 1 {
        writeln!(text, "/* The places of the outputs. */")?;
        let name = |kind: OutputKind| format!("STEER_{}", kind.name().to_uppercase());
        let places: Vec<String> = outputs.specs().iter().map(|output| name(output.name)).collect();
        writeln!(text, "enum {{ {}, STEER_OUTPUTS }};", places.join(", "))?;
        if let Some(mph) = outputs.top_speed_mph() {
            writeln!(text, "#define STEER_TOP_SPEED_MPH {mph:?}")?;
        }
        writeln!(text, "\n/* All outputs for a camera image; none is clamped.")?;
        for output in outputs.specs() {
            writeln!(text, " * {}: {}", name(output.name), outputs.meaning(output.name))?;
        }
        writeln!(text, " */\nvoid steer_outputs({IMAGE}, float outputs[STEER_OUTPUTS]);\n")?;
    }
    writeln!(text, "float steer({IMAGE});\n")?;
    for array in &program.tables {
        write_array(text, array)?;
    }
    if !program.constants.is_empty() {
        let constants: Vec<_> = program.constants.iter().map(|(name, value)| format!("{name} = {value}")).collect();
        writeln!(text, "enum {{ {} }};\n", constants.join(", "))?;
    }
    text.push_str(&pick_sections(LIBRARY, &program.sections));
    for array in &program.arrays {
        write_array(text, array)?;
    }
    for (buffer, len) in &program.buffers {
        let kind = if buffer.holds_bytes() { "uint8_t" } else { "float" };
        writeln!(text, "static {kind} {}[{len}];", buffer.name())?;
    }
    match outputs.count() {
        1 => writeln!(text, "\nfloat steer({IMAGE}) {{")?,
        _ => writeln!(text, "\nvoid steer_outputs({IMAGE}, float outputs[STEER_OUTPUTS]) {{")?,
    }
    for step in &program.statements {
        match step {
            Statement::Call { comment, function, args } => {
                if let Some(comment) = comment {
                    writeln!(text, "    /* {comment} */")?;
                }
                let args: Vec<String> = args.iter().map(argument).collect();
                writeln!(text, "{}", statement(function, &args, "    "))?;
            }
            Statement::Map { comment, buffer, len, formula } => {
                let x = format!("{}[i]", buffer.name());
                let value = expression(formula, &x, number);
                writeln!(text, "    /* {comment} */\n    for (int i = 0; i < {len}; i++) {{")?;
                writeln!(text, "        {x} = {value};\n    }}")?;
            }
        }
    }
    let result = program.result.name();
    if outputs.count() == 1 {
        return writeln!(text, "    return {result}[0];\n}}");
    }
    writeln!(text, "    for (int i = 0; i < STEER_OUTPUTS; i++) {{\n        outputs[i] = {result}[i];\n    }}\n}}\n")?;
    writeln!(text, "float steer({IMAGE}) {{\n    float outputs[STEER_OUTPUTS];\n    steer_outputs(image, outputs);")?;
    writeln!(text, "    return outputs[STEER_STEERING];\n}}")
}

fn write_array(text: &mut String, Array { name, values }: &Array) -> std::fmt::Result {
    let (kind, len, numbers) = match values {
        Values::F32(values) => ("float", values.len(), wrap(values.iter().map(|value| format!("{value:?}f")))),
        Values::I32(values) => ("int32_t", values.len(), wrap(values.iter().map(i32::to_string))),
        Values::U16(values) => ("uint16_t", values.len(), wrap(values.iter().map(u16::to_string))),
    };
    writeln!(text, "static const {kind} {name}[{len}] = {{\n{numbers}\n}};\n")
}

fn number(value: f32) -> String {
    format!("{value:?}f")
}

fn argument(arg: &Arg) -> String {
    let from = |buffer: &Buffer, offset: &usize| match offset {
        0 => buffer.name().to_string(),
        offset => format!("{} + {offset}", buffer.name()),
    };
    match arg {
        Arg::Image(range) if range.start == 0 => "image".into(),
        Arg::Image(range) => format!("image + {}", range.start),
        Arg::Read(buffer, offset) | Arg::Write(buffer, offset) => from(buffer, offset),
        Arg::Change(buffer, len) => format!("{}, {len}", buffer.name()),
        Arg::Array(name) => name.clone(),
        Arg::Int(value) => value.to_string(),
        Arg::Float(value) => number(*value),
        Arg::Sizes(name, fields) => {
            let fields: Vec<_> = fields.iter().map(|(field, value)| format!(".{field} = {value}")).collect();
            format!("(struct {name}){{{}}}", fields.join(", "))
        }
        Arg::Function(name) => name.to_string(),
    }
}
