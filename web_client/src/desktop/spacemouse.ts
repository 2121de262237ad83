// 3Dconnexion SpaceMouse by WebHID. Reports as publicly documented for the SpaceNavigator and its successors: 1 is the
// translation (with the rotation behind it in newer ones), 2 the rotation, 3 the buttons. Never run on hardware.

import { nowMs } from "../core/api.ts";

/** Multi-axis controllers (HID usage tables, page 1, usage 8) of 3Dconnexion, and of Logitech from before 2013. */
const FILTERS = [0x256f, 0x046d].map((vendorId) => ({ vendorId, usagePage: 1, usage: 8 }));
/** Logical maximum of every axis. */
const FULL = 350;
const REPORT = { translation: 1, rotation: 2, buttons: 3 } as const;

/** What a SpaceMouse reported last. `axes`: shares of their range, x y z and about x y z; right, to the person, down. */
export class SpaceMouseState {
  readonly axes = [0, 0, 0, 0, 0, 0];
  /** Bits of the pressed ones. Null until reported: they are reported when they change. */
  buttons: number | null = null;
  /** When the axes were reported, and when axes or buttons were. */
  moved_ms = 0;
  reported_ms = 0;

  /** Take an input report, without its id. Reports of other kinds, or too short ones, change nothing. */
  take(report: number, data: DataView, now_ms: number): void {
    if (report === REPORT.buttons && data.byteLength >= 1) {
      this.buttons = data.getUint8(0);
      this.reported_ms = now_ms;
    } else if (report === REPORT.translation || report === REPORT.rotation) {
      const begin = report === REPORT.rotation ? 3 : 0;
      const count = Math.min(6 - begin, Math.floor(data.byteLength / 2));
      if (count < 3) return;
      this.moved_ms = this.reported_ms = now_ms;
      for (let i = 0; i < count; i++) {
        this.axes[begin + i] = Math.min(1, Math.max(-1, data.getInt16(2 * i, true) / FULL));
      }
    }
  }

  clear(): void {
    this.axes.fill(0);
    this.buttons = null;
  }
}

interface HidReportEvent {
  reportId: number;
  data: DataView;
}

interface HidDevice extends EventTarget {
  opened: boolean;
  productName: string;
  vendorId: number;
  open(): Promise<void>;
}

/** What is needed of `navigator.hid`, which TypeScript does not know. */
interface Hid extends EventTarget {
  getDevices(): Promise<HidDevice[]>;
  requestDevice(options: { filters: typeof FILTERS }): Promise<HidDevice[]>;
}

/** The SpaceMouse of this browser. */
export class SpaceMouse {
  readonly state = new SpaceMouseState();
  /** Name of the device that is read, empty for none. */
  name = "";
  private readonly hid = (navigator as Navigator & { hid?: Hid }).hid;
  private device: HidDevice | null = null;

  constructor(private readonly onDisconnect: () => void) {
    this.hid?.addEventListener("disconnect", (event) => {
      if ((event as Event & { device?: HidDevice }).device !== this.device || this.device === null) return;
      this.device = null;
      this.name = "";
      this.state.clear();
      this.onDisconnect();
    });
  }

  /** False where the browser has no WebHID: all but Chromium, and pages that are no secure context. */
  get isSupported(): boolean {
    return this.hid !== undefined;
  }

  /** Read one that the person has allowed before, if any. */
  async reopen(): Promise<void> {
    const found = (await this.hid?.getDevices()) ?? [];
    const known = found.find((device) => FILTERS.some((filter) => filter.vendorId === device.vendorId));
    if (known) await this.read(known);
  }

  /** Let the person choose one; nothing happens if none is chosen. Call it from a click. */
  async choose(): Promise<void> {
    const [chosen] = (await this.hid?.requestDevice({ filters: FILTERS })) ?? [];
    if (chosen) await this.read(chosen);
  }

  private async read(device: HidDevice): Promise<void> {
    if (this.device === device) return;
    if (!device.opened) await device.open();
    this.device = device;
    this.name = device.productName;
    this.state.clear();
    device.addEventListener("inputreport", (event) => {
      const { reportId, data } = event as unknown as HidReportEvent;
      if (this.device === device) this.state.take(reportId, data, nowMs());
    });
  }
}
