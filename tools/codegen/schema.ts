// Template of schema.g.ts: tools/codegen/typescript_schema.py appends the tables, and drops this line.
// Tables of the iris-session protocol. Written by `python -m tools.codegen typescript-schema`: do not edit.
//
// Types of fields; ["null", type] is that type or null.
//   ["bool"], ["float"], ["int", lowest, highest] (null: no bound within int64), ["str", characters, pattern],
//   ["bytes", bytes], ["array", item, length, longest, shortest], ["map", item], ["struct", name], ["union", name].
// 0 or "" as a bound stands for none, as does one that is left out. `length` of an array: exactly so many items.

export type FieldType =
  | readonly ["bool" | "float"]
  | readonly ["int", number | null, number | null]
  | readonly ["str", number, string]
  | readonly ["bytes", number]
  | readonly ["array", FieldType, number, number, number?]
  | readonly ["map", FieldType]
  | readonly ["struct", string]
  | readonly ["union", string]
  | readonly ["null", FieldType];

/** One field: name, type, and the default in a list of its own; an empty list where the field is required. */
export type FieldRow = readonly [name: string, type: FieldType, fallback: readonly unknown[]];

/** One struct. `array`: a MessagePack array, else a map. `tag`: its tag field and tag, in a union. */
export interface StructTable {
  readonly array: boolean;
  readonly tag: readonly [field: string, tag: string] | null;
  readonly fields: readonly FieldRow[];
}
