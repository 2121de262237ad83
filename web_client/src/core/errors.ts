// Errors of the core.
//
//     WireError                 bytes or a value that do not fit the protocol
//     +-- MalformedError        not a message of the schema; `path` names the field
//     +-- VersionError          another protocol version
//     +-- TooLargeError         above the limit of its type
//     ClientError               what the application did cannot be done
//     +-- NotConnectedError     no connection to a session now
//     +-- InvalidMessageError   a value does not fit the protocol; nothing was sent
//     RefusedError              the session refused `hello`
//     PairingError              a join code that is none, or a session that could not prove that it knows it

/** Base of the errors of decoders: any bytes give a value or one of these. `code` is that of the protocol. */
export class WireError extends Error {
  override name = "WireError";
  constructor(
    text: string,
    readonly code: "malformed" | "version" | "too_large" = "malformed",
  ) {
    super(text);
  }
}

/** Bytes that are no message of the schema, or a value that is none. */
export class MalformedError extends WireError {
  override name = "MalformedError";
  /** Names of the fields that lead to the place, outermost first. */
  readonly path: (string | number)[] = [];

  constructor(private readonly reason: string) {
    super(reason);
  }

  /** Add the field that contains the place. */
  within(field: string | number): this {
    this.path.unshift(field);
    this.message = `${this.path.join(".")}: ${this.reason}`;
    return this;
  }
}

/** A message of another protocol version. */
export class VersionError extends WireError {
  override name = "VersionError";
  constructor(readonly version: number) {
    super(`protocol version ${version}: version 1 is spoken here`, "version");
  }
}

/** A message above the limit of its type. */
export class TooLargeError extends WireError {
  override name = "TooLargeError";
  constructor(what: string, size: number, limit: number) {
    super(`${what} of ${size} bytes: at most ${limit} are read`, "too_large");
  }
}

/** Base of the errors of the application's calls. */
export class ClientError extends Error {
  override name = "ClientError";
}

/** There is no connection to a session. */
export class NotConnectedError extends ClientError {
  override name = "NotConnectedError";
}

/** A message that does not fit the protocol. Nothing was sent. */
export class InvalidMessageError extends ClientError {
  override name = "InvalidMessageError";
}

/** The session refused `hello`. `code` is a `RefusalCode` or a `DenialReason`. */
export class RefusedError extends ClientError {
  override name = "RefusedError";
  readonly code: string;
  readonly advice: string;
  readonly supportedVersions: number[];

  constructor(refused: { code: string; message: string; advice: string; supported_versions: number[] }) {
    super([refused.message, refused.advice].filter((part) => part !== "").join("; "));
    this.code = refused.code;
    this.advice = refused.advice;
    this.supportedVersions = refused.supported_versions;
  }
}

/** Pairing failed. `code`: a `RefusalCode`, empty when no session answered or its proof was wrong. */
export class PairingError extends ClientError {
  override name = "PairingError";
  constructor(
    text: string,
    readonly code = "",
  ) {
    super(text);
  }
}
